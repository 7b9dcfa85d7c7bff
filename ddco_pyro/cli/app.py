"""The command line ``ddco-pyro``.

The exit status is 0 (done), 1 (failed) or 2 (bad input). An error is one line: the problem, its place and the
remedy; ``--debug`` shows the traceback. Commands import what they need when they are called.
"""

from __future__ import annotations

import gc
import io
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Annotated, Any

import typer

from ddco_pyro.cli import NARROW, checking, demos, fits, label, option, runs, starting
from ddco_pyro.errors import BadInput, Failed, reason

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None if NARROW else "rich",
    help="Discovers options in demonstrations: a hierarchy of skills, declared in YAML, "
    "fitted by exact inference.",
    epilog="--debug, anywhere on the line, shows the traceback of an error.",
)
EXAMPLES: dict[Callable[..., None], str] = {
    starting.demo: "demo --out runs/demo",
    starting.new: "new mine.hdf5 --out runs/mine",
    demos.import_: "import pusht --out demos.hdf5",
    demos.inspect: "inspect mine.hdf5",
    demos.encode: "encode demos.hdf5 --observation camera --encoder timm:resnet18.a1_in1k --out encoded.hdf5",
    demos.init: "init mine.hdf5 --out mine.yaml",
    fits.check: "check specs/needle.yaml --set hierarchy.levels.0.count=3",
    fits.fit: "fit specs/needle.yaml --set training.epochs=50 --out runs/short",
    runs.report: "report runs/needle",
    runs.segment: "segment runs/mine mine.hdf5 --html segments.html",
    label.label: "label runs/mine mine.hdf5 --out labelled.hdf5",
    fits.select: "select specs/mine.yaml --set selection.grid.hierarchy.levels.0.count=[1,2,4,8]",
    runs.compare: "compare runs/needle runs/needle/baselines/flat runs/other",
    demos.collect: "collect specs/needle.yaml --out needle.hdf5",
    runs.rollout: "rollout runs/needle --episodes 200 --video",
    runs.export: "export runs/mine --out controller --onnx",
}
"""Every command, in the order of ``--help``: as a user needs them."""


def _print_version(asked: bool) -> None:
    if asked:
        print(f"ddco-pyro {version('ddco-pyro')}")
        raise typer.Exit


@app.callback()
def top(
    _: Annotated[
        bool, option("Print the version.", "--version", is_eager=True, callback=_print_version)
    ] = False,
) -> None:
    """Options that need no command."""


for command, example in EXAMPLES.items():
    app.command(example.partition(" ")[0], epilog=f"Example: ddco-pyro {example}")(checking(command))


def main() -> None:
    """Run the command line; ends the process with 0, 1 or 2."""
    gc.set_threshold(*gc.get_threshold()[:2], 1000)  # searching all that is imported takes most of a second
    with _interruptible():
        status = _run()
    if not ("ompl" in sys.modules or "--allow-code" in sys.argv):  # bindings may report what Python leaves
        gc.freeze()  # a last search for garbage would take a second
    sys.exit(status)


@contextmanager
def _interruptible() -> Iterator[None]:
    """While the context lasts, SIGTERM (preemption by a scheduler) interrupts like Ctrl-C."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run() -> int:
    """The exit status of the command line."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # for characters that the terminal's encoding lacks
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    if "--allow-code" in arguments:
        sys.path.append(os.getcwd())  # where a user's module:name lies
    try:
        status = app(arguments or ["--help"], prog_name="ddco-pyro", standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader, such as head, has closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 1
    except Exception as error:
        status, lines = _explain(error)
        if "--debug" in sys.argv:
            traceback.print_exc()
        else:
            print(*(f"ddco-pyro: {line}" for line in lines), sep="\n", file=sys.stderr)
    if status == INTERRUPTED:
        print("ddco-pyro: interrupted", file=sys.stderr)
        status = 1
    return status or 0


INTERRUPTED = 130
"""Typer's status after Ctrl-C."""

UsageError: Any = typer.BadParameter.__base__
"""Click's error for a wrong argument or option, which typer does not export."""


def _explain(error: Exception) -> tuple[int, list[str]]:
    """The exit status, and a line for each problem."""
    if isinstance(error, UsageError):
        command = error.ctx.command_path if error.ctx else "ddco-pyro"
        return 2, [f"{error.format_message().rstrip('.')}; see {command} --help"]
    if isinstance(error, BadInput):
        return 2, str(error).splitlines()
    expected = isinstance(error, Failed | OSError)
    return 1, [reason(error) if expected else f"{reason(error)}; --debug shows where it comes from"]
