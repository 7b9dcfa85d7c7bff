"""The command line: ``ddco-pyro check | collect | fit | select | compare | rollout | report``.

Every command ends with 0 (done), 1 (failed) or 2 (bad input), and says in one line what is wrong, where, and what to
do; ``--debug`` shows the traceback.
"""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
import traceback
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from ddco_pyro.cli import console
from ddco_pyro.cli import data as incoming
from ddco_pyro.cli import outputs as outgoing
from ddco_pyro.cli.options import AllowCode, RunPath
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.spec import Spec, SpecError, dump_spec, load_spec, spec_schema, user_code

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Discovers options in demonstrations: a hierarchy of skills, declared in YAML, fitted by exact inference.",
    epilog="--debug, anywhere on the line, shows the traceback of an error.",
)

SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The spec, a YAML file.", show_default=False)]
Overrides = Annotated[
    list[str], typer.Option("--set", metavar="KEY=VALUE", help="Another value for a key of the spec; repeatable.")
]


class Backend(StrEnum):
    """Where folds are trained."""

    LOKY = "loky"
    DASK = "dask"


Jobs = Annotated[int, typer.Option(help="Processes that run episodes; -1 is one for each core.")]


@app.command(epilog="Example: ddco-pyro check specs/needle.yaml --set hierarchy.levels.0.count=3")
def check(
    spec: Annotated[Path | None, typer.Argument(metavar="[SPEC]", help="The spec, a YAML file.")] = None,
    overrides: Overrides = [],  # noqa: B006 (typer reads the default, nobody changes it)
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON Schema of specs instead.")] = False,
    allow_code: AllowCode = False,
) -> None:
    """Print the spec with all defaults, the shapes it works on, and the parameters of each network."""
    if schema:
        print(json.dumps(spec_schema(), indent=2))
        return
    if spec is None:
        raise SpecError("name a spec, such as: ddco-pyro check specs/needle.yaml")
    found = load_spec(spec, overrides, allow_code)
    from ddco_pyro.fitting.prepare import baselines, check_networks, dimensions

    size = dimensions(found)
    hierarchy = check_networks(found, size)
    print(dump_spec(found), end="")
    console.dimensions(found, size, hierarchy, baselines(found, size))
    console.control(size)


@app.command(epilog="Example: ddco-pyro collect specs/needle.yaml --out needle.hdf5")
def collect(
    spec: SpecPath,
    out: Annotated[Path | None, typer.Option(help="The HDF5 file; by default in the cache, by content.")] = None,
    overrides: Overrides = [],  # noqa: B006
    allow_code: AllowCode = False,
) -> None:
    """Record demonstrations of the task's supervisor, unless they are there already."""
    found = load_spec(spec, overrides, allow_code)
    if found.demonstrated_task is None:
        raise SpecError(f"{spec}: names no task, so there is no supervisor to record")
    from ddco_pyro.simulation.collect import collect as record

    own = found.demonstrations.path
    with console.Collecting() as progress:
        path = record(
            found.demonstrated_task, found.demonstrations, out or (Path(own) if own else None), progress.collected
        )
    print(path)


@app.command(epilog="Example: ddco-pyro fit specs/needle.yaml --set training.epochs=50 --out runs/short")
def fit(
    spec: SpecPath,
    out: Annotated[Path | None, typer.Option(help="The run folder; by default runs/SPEC-TIME.")] = None,
    overrides: Overrides = [],  # noqa: B006
    resume: Annotated[bool, typer.Option("--resume", help="Where --out holds this run whole, show it again.")] = False,
    allow_code: AllowCode = False,
) -> None:
    """Fit the spec's hierarchy and its baselines; write the run folder with its report.

    An unfinished run of this very spec in --out is continued.
    """
    found = load_spec(spec, overrides, allow_code)
    from ddco_pyro.fitting import run
    from ddco_pyro.fitting.prepare import check_networks, demonstrations, dimensions
    from ddco_pyro.report import degeneracies, unconverged, write_report

    check_networks(found, dimensions(found))  # before anything is collected, trained or written
    folder = out or Path("runs") / f"{spec.stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    run.claim(folder, found, resume)
    try:
        with console.Fitting() as watcher:
            fitted = run.fit(found, folder, watcher)
    except KeyboardInterrupt:
        resolved = folder / "spec.yaml"
        again = f"ddco-pyro fit {resolved} --out {folder} --resume{_allowed(found)}"
        print(f"interrupted; continue with: {again}", file=sys.stderr)
        raise typer.Exit(1) from None
    console.log_likelihoods(fitted.metrics)
    console.warnings([*unconverged(fitted.metrics), *degeneracies(fitted.spec, fitted.metrics)])
    print(f"report: {write_report(fitted, demonstrations(found))}")
    if found.hierarchy and found.demonstrations.path:
        file = shlex.quote(found.demonstrations.path)
        print(f"next: ddco-pyro segment {shlex.quote(str(folder))} {file} --html segments.html{_allowed(found)}")


def _allowed(spec: Spec) -> str:
    """What has to be said again so that the user code of this spec is imported again."""
    return " --allow-code" if user_code(spec) else ""


@app.command(epilog="Example: ddco-pyro select specs/mine.yaml --set selection.grid.hierarchy.levels.0.count=[1,2,4,8]")
def select(
    spec: SpecPath,
    out: Annotated[Path | None, typer.Option(help="The folder; by default runs/SPEC-select-TIME.")] = None,
    overrides: Overrides = [],  # noqa: B006
    folds: Annotated[int | None, typer.Option(help="Number of folds; by default the spec's selection.folds.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes that train folds; -1 is one for each core.")] = -1,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the unfinished selection in --out.")] = False,
    stop_early: Annotated[bool, typer.Option("--stop-early", help="Give hopeless candidates up.")] = False,
    backend: Annotated[Backend, typer.Option(help="Where folds are trained: loky (here) or dask.")] = Backend.LOKY,
    scheduler: Annotated[str | None, typer.Option(help="Address of the dask scheduler, tcp://HOST:PORT.")] = None,
    allow_code: AllowCode = False,
) -> None:
    """Choose among the candidates of the spec's grid by cross-validation; then fit what was chosen to all the data.

    With --stop-early, after each fold from the third on, a candidate is given up where the paired t-test over the folds
    so far puts it below the best so far (one-sided, p < 0.001), or where a fold of it has failed.
    """
    number = [] if folds is None else [f"selection.folds={folds}"]
    found = load_spec(spec, [*overrides, *number], allow_code)
    if (backend is Backend.DASK) != (scheduler is not None):
        raise SpecError("--backend dask and --scheduler tcp://HOST:PORT go together; give both or neither")
    from ddco_pyro import selection
    from ddco_pyro.fitting import run
    from ddco_pyro.fitting.prepare import demonstrations
    from ddco_pyro.report import degeneracies, unconverged, write_report
    from ddco_pyro.selection.table import HEAD, cells

    workers = selection.Workers(jobs, scheduler)
    selection.check(found, workers)  # before anything is collected, trained or written
    folder = out or Path("runs") / f"{spec.stem}-select-{time.strftime('%Y%m%d-%H%M%S')}"
    run.claim(folder, found, resume)
    try:
        with console.Selecting() as watcher:
            made = selection.select(found, folder, watcher, workers, stop_early)
            watcher.end()
            assert made.choice.chosen is not None  # or it would have failed
            final = selection.final_spec(found, made.choice.chosen.candidate)
            fitted = run.fit(final, folder / "fit", watcher)
    except KeyboardInterrupt:
        early = " --stop-early" * stop_early
        again = f"ddco-pyro select {folder / 'spec.yaml'} --out {folder} --resume{early}{_allowed(found)}"
        print(f"interrupted; continue with: {again}", file=sys.stderr)
        raise typer.Exit(1) from None
    console.selection(made.choice, HEAD, [cells(row, made.choice) for row in made.choice.rows])
    console.warnings([*unconverged(fitted.metrics), *degeneracies(fitted.spec, fitted.metrics)])
    print(f"selection: {folder / 'selection.json'}")
    print(f"report: {write_report(fitted, demonstrations(fitted.spec))}")


@app.command(epilog="Example: ddco-pyro compare runs/needle runs/needle/baselines/flat runs/other")
def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders; a run's baselines are some too.")
    ],
    out: Annotated[Path | None, typer.Option(help="The folder to write to; by default runs/compare-TIME.")] = None,
    allow_code: AllowCode = False,
) -> None:
    """Compare runs on the demonstrations that all of them held out, and on rollouts from the same initial states."""
    from ddco_pyro import comparison
    from ddco_pyro.comparison import page

    found = comparison.compare(runs, allow_code)
    console.comparison(page.HEAD, [page.cells(row) for row in found.rows])
    if found.rollouts:
        console.comparison(page.ROLLOUT_HEAD, page.rollout_cells(found))
    print(page.verdict(found))
    print(f"comparison: {comparison.write(found, out or Path('runs') / time.strftime('compare-%Y%m%d-%H%M%S'))}")


@app.command(epilog="Example: ddco-pyro rollout runs/needle --episodes 200 --video")
def rollout(
    run: RunPath,
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes of each method; by default the spec's.")] = None,
    video: Annotated[bool, typer.Option("--video", help="Film the first episodes of each method.")] = False,
    jobs: Jobs = -1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Where RUN holds these very rollouts, show them again.")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Roll the model, its baselines and the spec's scripted policies out from the same initial states.

    An unfinished rollout of as many episodes is continued.
    """
    from ddco_pyro.fitting.fit import load
    from ddco_pyro.fitting.prepare import demonstrations
    from ddco_pyro.fitting.rollouts import policies, roll_out
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    number = episodes or fitted.spec.rollout.episodes
    with console.Rolling(number * len(policies(fitted))) as progress:
        results = roll_out(fitted, number, FILMED if video else 0, progress.episode, jobs, resume)
    console.successes(results)
    print(f"report: {write_report(fitted, demonstrations(fitted.spec))}")


FILMED = 3
"""Episodes of each method that ``rollout --video`` films."""


@app.command(epilog="Example: ddco-pyro report runs/needle")
def report(run: RunPath, allow_code: AllowCode = False) -> None:
    """Write the report of a run again."""
    from ddco_pyro.fitting.fit import load
    from ddco_pyro.fitting.prepare import demonstrations
    from ddco_pyro.report import write_report

    fitted = load(run, allow_code)
    print(f"report: {write_report(fitted, demonstrations(fitted.spec))}")


app.command(epilog="Example: ddco-pyro inspect mine.hdf5")(incoming.inspect)
app.command(epilog="Example: ddco-pyro init mine.hdf5 --out mine.yaml")(incoming.init)
app.command("import", epilog="Example: ddco-pyro import pusht --out demos.hdf5")(incoming.import_)
app.command(epilog="Example: ddco-pyro segment runs/mine mine.hdf5 --html segments.html")(outgoing.segment)
app.command(epilog="Example: ddco-pyro export runs/mine --out controller --onnx")(outgoing.export)


def main() -> None:
    """Run the command line; ends the process with 0, 1 or 2."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    if "--allow-code" in arguments:
        sys.path.append(os.getcwd())  # where a user's module:name lies
    try:
        status = app(arguments or ["--help"], prog_name="ddco-pyro", standalone_mode=False)
    except Exception as error:
        status, lines = _explain(error)
        if "--debug" in sys.argv:
            traceback.print_exc()
        else:
            print(*(f"ddco-pyro: {line}" for line in lines), sep="\n", file=sys.stderr)
    if status == INTERRUPTED:
        print("ddco-pyro: interrupted", file=sys.stderr)
        status = 1
    sys.exit(status or 0)


INTERRUPTED = 130
"""What typer makes of Ctrl-C."""

UsageError: Any = typer.BadParameter.__base__
"""A wrong argument or option: click's own error, which typer does not name."""


def _explain(error: Exception) -> tuple[int, list[str]]:
    """The exit status, and a line for each thing that is wrong."""
    if isinstance(error, UsageError):
        command = error.ctx.command_path if error.ctx else "ddco-pyro"
        return 2, [f"{error.format_message().rstrip('.')}; see {command} --help"]
    if isinstance(error, BadInput):
        return 2, str(error).splitlines()
    message = " ".join(str(error).split())
    if isinstance(error, Failed | OSError):
        return 1, [message]
    return 1, [f"unexpected {type(error).__name__}: {message}; --debug shows where it comes from"]
