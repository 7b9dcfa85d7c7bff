"""Commands for a first look: ``demo`` and ``new``, which call the other commands one after another."""

from __future__ import annotations

import os
import sys
import webbrowser
from importlib.metadata import entry_points
from importlib.resources import as_file, files
from pathlib import Path
from typing import Annotated

import typer

from ddco_pyro.cli import demos, fits, option, runs, written
from ddco_pyro.errors import BadInput, Failed, command
from ddco_pyro.spec import load_spec

Show = Annotated[
    bool, option("Show the page in a browser, where there is a terminal and a display.", "--open/--no-open")
]


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An HDF5 file of demonstrations.")],
    out: Annotated[Path | None, written("folder", "The folder to write to; by default runs/FILE.")] = None,
    show: Show = True,
) -> None:
    """From a file to segments on a page: inspect, init, fit and segment.

    The folder has spec.yaml, to be changed as you like, the run folder run, and segments.html. Called again
    with the same folder, the command continues.
    """
    folder = out or Path("runs") / file.stem
    spec, run, page = folder / "spec.yaml", folder / "run", folder / "segments.html"
    from ddco_pyro.cli import console
    from ddco_pyro.data.inspection import inspect

    _say("inspect", file)
    console.inspection(inspect(file))
    if spec.exists():
        refuse_other(spec, file, "choose another --out")
    else:
        _say("init", file, "--out", spec)
        folder.mkdir(parents=True, exist_ok=True)
        demos.write_spec(file, spec)
    _say("fit", spec, "--out", run)
    fits.fit_and_report(load_spec(spec), spec, run, resume=True)
    _say("segment", run, file, "--html", page)
    runs.segment(run=run, demos=file, html=page)
    if show and sys.stdout.isatty() and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        webbrowser.open(page.resolve().as_uri())


def refuse_other(spec: Path, file: Path, remedy: str) -> None:
    """Refuse a spec that is for another file of demonstrations.

    :raises BadInput: it is.
    """
    fitted_to = load_spec(spec).demonstrations.path
    if fitted_to is None or Path(fitted_to).resolve() != file.resolve():
        raise BadInput(f"{spec}: is for {fitted_to}; {remedy}")


TASK = "needle"
"""The task of the demo; its package holds ``demo.yaml``."""


def demo(
    out: Annotated[Path, written("folder", "The folder to write to.")] = Path("runs/demo"), show: Show = True
) -> None:
    """Fit a small example: the simulated needle task, or generated pick-and-place where it cannot be
    simulated.

    Called again, an unfinished demo is continued.
    """
    from ddco_pyro.data.planted import pick_and_place
    from ddco_pyro.simulation.task import find_task

    file = out / "pick_and_place.hdf5"
    try:
        find_task(TASK)
    except (BadInput, Failed) as error:
        print(f"{error}; so here are generated demonstrations\n")
        if not file.exists():
            pick_and_place().write(file)
        new(file, out, show)
        return
    (point,) = (point for point in entry_points(group="ddco_pyro.tasks") if point.name == TASK)
    with as_file(files(point.module) / "demo.yaml") as spec:
        _say("fit", spec, "--out", out)
        fits.fit_and_report(load_spec(spec), spec, out, resume=True)
    _say("rollout", out)
    runs.rollout(out, resume=True)


def _say(*words: object) -> None:
    print(f"\n$ {command(*words)}")
