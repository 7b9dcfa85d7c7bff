"""Commands that fit: ``check``, ``fit`` and ``select``."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ddco_pyro.cli import AllowCode, Overrides, SpecPath, Wheres, option, where_of, written
from ddco_pyro.errors import BadInput, Failed, command
from ddco_pyro.events import Event, Log
from ddco_pyro.jobs import Workers
from ddco_pyro.spec import Spec, SpecError, dump_spec, load_spec, spec_schema, user_code, with_overrides

if TYPE_CHECKING:
    from ddco_pyro.fitting.fitted import Fit


def check(
    spec: Annotated[Path | None, typer.Argument(metavar="[SPEC]", help="The spec, a YAML file.")] = None,
    overrides: Overrides = [],  # noqa: B006 (typer reads the default, which never changes)
    schema: Annotated[bool, option("Print the JSON Schema of specs instead.", "--schema")] = False,
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
    from ddco_pyro.data.labels import label_names
    from ddco_pyro.training.data import dimensions, in_file, outline, refuse_unfit
    from ddco_pyro.training.labels import used
    from ddco_pyro.training.networks import check_models

    demos = outline(loaded) if in_file(loaded) else None
    if loaded.training.library is None:
        size = dimensions(loaded, demos)
    else:
        from ddco_pyro.fitting.library import dimensions_for  # and all that infers

        size = dimensions_for(loaded, demos)
    (_, hierarchy), *baselines = check_models(loaded, size).values()
    if demos is not None:
        refuse_unfit(loaded, demos)
    labels, known = (used(loaded, demos), label_names(demos.attributes)) if demos else (None, {})
    print(dump_spec(loaded), end="")
    console.model(loaded, size, hierarchy, baselines)
    console.labels(loaded, labels, known)


def fit(
    spec: SpecPath,
    out: Annotated[Path | None, written("folder", "The run folder; by default runs/SPEC-TIME.")] = None,
    overrides: Overrides = [],  # noqa: B006
    library: Annotated[
        Path | None,
        option(
            "A run of other tasks, at whose options this one begins; SPEC then says what differs.",
            metavar="RUN",
        ),
    ] = None,
    wheres: Wheres = [],  # noqa: B006
    jobs: Annotated[
        int | None,
        option(
            "Processes that train restarts, or baselines beside the model; -1, the default, is one for each "
            "core, 1 is this process alone."
        ),
    ] = None,
    seeds: Annotated[
        int | None, option("Fit with so many training seeds in all, and report their variation.", min=2)
    ] = None,
    log: Annotated[
        list[str],
        option("Log training, too: tensorboard or wandb-offline; repeatable.", "--log", metavar="NAME"),
    ] = [],  # noqa: B006
    resume: Annotated[
        bool, option("Where --out holds this run, finished, show it again.", "--resume")
    ] = False,
    allow_code: AllowCode = False,
) -> None:
    """Fit the spec's options and its baselines; write the run folder with its report.

    An unfinished run of the same spec in --out is continued, with any number of processes. Under torchrun
    processes share each gradient step, at most training.shards of them.

    With --library one demonstration is enough: all that there are train, from the options of another run.

    With --seeds the fit and its baselines are repeated, in --jobs processes, with other training seeds: other
    first weights, clusters and orders of the same demonstrations. RUN/seeds has a run for each.
    """
    from ddco_pyro.training.processes import together

    with together() as ranks:
        if ranks.rank > 0:
            from ddco_pyro.training.restarts import follow

            with suppress(BadInput, Failed):  # the first process reports an error that all have
                follow(ranks)
            return
        if library is None:
            loaded = load_spec(spec, overrides, allow_code)
        else:
            from ddco_pyro.fitting.library import for_new_task

            loaded = for_new_task(spec, library, overrides, allow_code)
        if wheres:
            loaded = with_overrides(loaded, {"demonstrations.where": where_of(wheres)})
        if ranks.size > 1 and jobs not in (None, 1):
            raise SpecError(f"--jobs {jobs}: the processes of torchrun train together; leave --jobs out")
        jobs = 1 if ranks.size > 1 else -1 if jobs is None else jobs
        folder = out or Path("runs") / f"{spec.stem}-{time.strftime('%Y%m%d-%H%M%S')}"
        fit_and_report(loaded, spec, folder, jobs, seeds, resume, [*dict.fromkeys(log)])
        file = loaded.demonstrations.path
        if loaded.hierarchy and file:
            print(f"next: {command('segment', folder, file, '--html', 'segments.html', *_allowed(loaded))}")


def fit_and_report(
    loaded: Spec,
    spec: Path,
    folder: Path,
    jobs: int = -1,
    seeds: int | None = None,
    resume: bool = False,
    logs: Sequence[str] = (),
) -> None:
    """Do what ``fit`` does with a spec that is read from ``spec``."""
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.fit import fit as fitted_to
    from ddco_pyro.fitting.fit import repeat, training_seeds

    if seeds is not None:
        training_seeds(loaded, seeds)  # or they are refused
    repeated = () if seeds is None else ("--seeds", str(seeds))
    more = [word for name in logs for word in ("--log", name)]
    logged = [Log(name, folder, loaded.model_dump(mode="json"), console.say) for name in logs]
    given = [*repeated, *more, *_allowed(loaded)]
    again = command("fit", folder / "spec.yaml", "--out", folder, "--resume", *given)
    with _continued(again, folder), console.Progress() as progress, ExitStack() as stack:
        for log in logged:
            stack.enter_context(log)

        def listen(event: Event) -> None:
            progress(event)
            for log in logged:
                log(event)

        fitted = fitted_to(loaded, None, folder, listen, jobs, resume)
        for log in logged:
            log.add(_held_out(fitted))
        if seeds is not None:
            fitted = repeat(fitted, seeds, progress, jobs)
    from ddco_pyro.report import write_report

    console.library(fitted)
    console.skills(fitted)
    console.names(fitted)
    console.warnings(fitted)
    console.log_likelihoods(fitted)
    console.seeds(fitted.metrics)
    print(f"report: {write_report(fitted, fitted.demonstrations)}")


def _held_out(fitted: Fit) -> dict[str, float]:
    """The held-out log-likelihood of each model, nats per step, by its name in a log."""
    metrics = fitted.metrics
    each = {metrics.model: metrics.log_likelihood_per_step.valid}
    each |= {name: found.log_likelihood_per_step.valid for name, found in metrics.comparison.items()}
    return {f"{name}/held_out": value for name, value in each.items() if value is not None}


def select(
    spec: SpecPath,
    out: Annotated[Path | None, written("folder", "The folder; by default runs/SPEC-select-TIME.")] = None,
    overrides: Overrides = [],  # noqa: B006
    folds: Annotated[int | None, option("Number of folds; by default the spec's selection.folds.")] = None,
    jobs: Annotated[int, option("Processes that train folds; -1 is one for each core.")] = -1,
    resume: Annotated[bool, option("Continue the unfinished selection in --out.", "--resume")] = False,
    allow_code: AllowCode = False,
) -> None:
    """Choose among candidates of the spec's grid by cross-validation; then fit the chosen one to all data."""
    number = [] if folds is None else [f"selection.folds={folds}"]
    loaded, workers = load_spec(spec, [*overrides, *number], allow_code), Workers(jobs)
    folder = out or Path("runs") / f"{spec.stem}-select-{time.strftime('%Y%m%d-%H%M%S')}"
    from ddco_pyro import selection
    from ddco_pyro.cli import console
    from ddco_pyro.fitting.fit import fit as fitted_to

    demos = selection.known_demonstrations(loaded)
    selection.check(loaded, demos)  # before anything is collected, trained or written
    again = command("select", folder / "spec.yaml", "--out", folder, "--resume", *_allowed(loaded))
    with _continued(again, folder), console.Progress() as progress:
        made = selection.select(loaded, folder, progress, workers, demos, resume)
        progress.end()
        assert made.choice.chosen is not None  # or it would have failed
        final = selection.final_spec(made.choice.chosen.candidate)
        fitted = fitted_to(final, made.demos, folder / "fit", progress, jobs, keep=False)
    from ddco_pyro.report import write_report
    from ddco_pyro.selection.choice import table

    console.show(table(made.choice, "held-out log-likelihood by cross-validation, nats per step"))
    for note in made.choice.notes:
        console.say(f"note: {note}")
    console.warnings(fitted)
    print(f"selection: {folder / 'selection.json'}")
    print(f"report: {write_report(fitted, fitted.demonstrations)}")


@contextmanager
def _continued(again: str, folder: Path) -> Iterator[None]:
    """On Ctrl-C, print the command that continues and exit with 1, where a run has begun."""
    try:
        yield
    except KeyboardInterrupt:
        if not (folder / "spec.yaml").exists():
            raise
        print(f"interrupted; continue with: {again}", file=sys.stderr)
        raise typer.Exit(1) from None


def _allowed(spec: Spec) -> list[str]:
    """``--allow-code`` where the spec names user code."""
    return ["--allow-code"] if user_code(spec) else []
