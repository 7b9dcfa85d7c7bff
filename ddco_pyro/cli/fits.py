"""From a spec to a fit: ``check``, ``fit``, ``select`` and ``merge``."""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ddco_pyro.cli.options import AllowCode, Overrides, RunPath, SpecPath
from ddco_pyro.spec import Spec, SpecError, dump_spec, load_spec, spec_schema, user_code

if TYPE_CHECKING:
    from ddco_pyro.fitting.fit import Fit


class Backend(StrEnum):
    """Where folds are trained."""

    LOKY = "loky"
    DASK = "dask"


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
    loaded = load_spec(spec, overrides, allow_code)
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.building import baselines, check_networks
    from ddco_pyro.fitting.labels import used
    from ddco_pyro.fitting.prepare import dimensions, in_file, outline

    demos = outline(loaded) if in_file(loaded) else None
    size = dimensions(loaded, demos)
    hierarchy = check_networks(loaded, size)
    labels = used(loaded, demos) if demos else None
    print(dump_spec(loaded), end="")
    console.dimensions(loaded, size, hierarchy, baselines(loaded, size))
    console.control(size, hierarchy)
    console.device(loaded)
    console.labels(loaded, labels)


def fit(
    spec: SpecPath,
    out: Annotated[Path | None, typer.Option(help="The run folder; by default runs/SPEC-TIME.")] = None,
    overrides: Overrides = [],  # noqa: B006
    jobs: Annotated[
        int | None,
        typer.Option(help="Processes that train restarts side by side; -1, the default, is one for each core."),
    ] = None,
    processes: Annotated[
        int | None,
        typer.Option(help="Processes that share each gradient step, at most training.shards; under torchrun its own."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Where --out holds this run whole, show it again.")] = False,
    allow_code: AllowCode = False,
) -> None:
    """Fit the spec's hierarchy and its baselines; write the run folder with its report.

    An unfinished run of this very spec in --out is continued, with any number of processes.
    """
    from ddco_pyro.fitting.launching import follow_torchrun, launched, leading, requested

    ranks = launched()
    if ranks and ranks.rank > 0:
        follow_torchrun(ranks)
        return
    with leading(ranks):
        _fit(load_spec(spec, overrides, allow_code), spec.stem, out, jobs, requested(processes, ranks), resume)


def _fit(loaded: Spec, name: str, out: Path | None, jobs: int | None, processes: int, resume: bool) -> None:
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.run import fit_run
    from ddco_pyro.report import write_report

    if jobs is None:
        jobs = -1 if processes == 1 else 1
    folder = out or Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    with (
        _continued(f"fit {folder / 'spec.yaml'} --out {folder} --resume{_allowed(loaded)}", folder),
        console.Progress() as progress,
    ):
        fitted = fit_run(loaded, None, folder, progress, jobs, resume, processes=processes)
    console.log_likelihoods(fitted.metrics)
    _warn(fitted)
    print(f"report: {write_report(fitted, fitted.demonstrations)}")
    if loaded.hierarchy and loaded.demonstrations.path:
        file = shlex.quote(loaded.demonstrations.path)
        print(f"next: ddco-pyro segment {shlex.quote(str(folder))} {file} --html segments.html{_allowed(loaded)}")


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
    loaded = load_spec(spec, [*overrides, *number], allow_code)
    if (backend is Backend.DASK) != (scheduler is not None):
        raise SpecError("--backend dask and --scheduler tcp://HOST:PORT go together; give both or neither")
    from ddco_pyro import selection
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.prepare import seen
    from ddco_pyro.fitting.run import fit_run
    from ddco_pyro.report import write_report
    from ddco_pyro.selection.table import HEAD, cells

    workers = selection.Workers(jobs, scheduler)
    demos = selection.known_demonstrations(loaded)
    selection.check(loaded, workers, demos)  # before anything is collected, trained or written
    folder = out or Path("runs") / f"{spec.stem}-select-{time.strftime('%Y%m%d-%H%M%S')}"
    early = " --stop-early" * stop_early
    again = f"select {folder / 'spec.yaml'} --out {folder} --resume{early}{_allowed(loaded)}"
    with _continued(again, folder), console.Progress() as progress:
        made = selection.select(loaded, folder, progress, workers, stop_early, demos, resume)
        progress.end()
        assert made.choice.chosen is not None  # or it would have failed
        final = selection.final_spec(made.choice.chosen.candidate)
        fitted = fit_run(final, seen(final, made.demos), folder / "fit", progress, jobs)
    console.selection(made.choice, HEAD, [cells(row, made.choice) for row in made.choice.rows])
    _warn(fitted)
    print(f"selection: {folder / 'selection.json'}")
    print(f"report: {write_report(fitted, fitted.demonstrations)}")


def merge(
    run: RunPath,
    options: Annotated[
        tuple[int, int] | None,
        typer.Option(help="Numbers of the two options; by default those that act most alike.", show_default=False),
    ] = None,
    level: Annotated[str | None, typer.Option(help="Name of their level; by default the lowest.")] = None,
    out: Annotated[Path | None, typer.Option(help="The run folder; by default RUN-merged.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes that train restarts; -1 is one for each core.")] = -1,
    allow_code: AllowCode = False,
) -> None:
    """Make two options of a run one, and fit again from its segments; write a run folder of its own.

    Called again, an unfinished one is continued.
    """
    from ddco_pyro.cli import console
    from ddco_pyro.fitting import merging
    from ddco_pyro.fitting.fit import load
    from ddco_pyro.report import write_report

    before = load(run, allow_code)
    pair = merging.chosen(before, level, options)
    folder = out or run.with_name(f"{run.name}-merged")
    with console.Progress() as progress:
        fitted = merging.merge(before, pair, folder, progress, jobs)
    console.log_likelihoods(fitted.metrics)
    console.merged(pair, before.metrics, fitted.metrics)
    _warn(fitted)
    print(f"report: {write_report(fitted, fitted.demonstrations)}")
    print(f"next: ddco-pyro compare {shlex.quote(str(run))} {shlex.quote(str(folder))}{_allowed(fitted.spec)}")


@contextmanager
def _continued(command: str, folder: Path) -> Iterator[None]:
    """Ctrl-C ends with 1 and the command that continues, where there is something to continue."""
    try:
        yield
    except KeyboardInterrupt:
        if not (folder / "spec.yaml").exists():
            raise
        print(f"interrupted; continue with: ddco-pyro {command}", file=sys.stderr)
        raise typer.Exit(1) from None


def _warn(fitted: Fit) -> None:
    """Signs of too short a training, and of a degenerate solution."""
    from ddco_pyro.cli import console
    from ddco_pyro.report import degeneracies, unconverged

    console.warnings([*unconverged(fitted.metrics), *degeneracies(fitted.spec, fitted.metrics)])


def _allowed(spec: Spec) -> str:
    """What has to be said again so that the user code of this spec is imported again."""
    return " --allow-code" if user_code(spec) else ""
