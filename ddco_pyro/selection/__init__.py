"""Selection by k-fold cross-validation (paper §4.3) over a grid of spec keys, with the same folds for all.

The folder holds ``selection.json`` (the result), ``folds/`` (the run folder of each candidate's fit without a
fold), ``fit/`` (the final fit) and ``demonstrations.json`` (the digest of the demonstrations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import Damaged, json_text, write_text
from ddco_pyro.errors import Failed, reason
from ddco_pyro.events import CellDone, CellsBegan, OnEvent, ignore
from ddco_pyro.fitting.digest import record
from ddco_pyro.fitting.fit import fit_beside
from ddco_pyro.fitting.fitted import load
from ddco_pyro.fitting.run import claimed, is_finished
from ddco_pyro.inference import compile_all
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Metrics
from ddco_pyro.selection import choice as choosing
from ddco_pyro.selection import grid
from ddco_pyro.selection.choice import Choice
from ddco_pyro.selection.grid import Candidate, assign, divide
from ddco_pyro.spec import EACH, Spec, with_overrides
from ddco_pyro.training import data
from ddco_pyro.training.networks import Dimensions, model_name
from ddco_pyro.training.processes import one_thread

__all__ = [
    "Choice",
    "Failed",
    "Selection",
    "Workers",
    "check",
    "final_spec",
    "known_demonstrations",
    "select",
]

ALL_CORES = Workers()
"""One process for each core."""


@dataclass(frozen=True)
class Selection:
    """A finished cross-validation, its folder, and demonstrations with the observations of every candidate.

    :param held_out: the names of the demonstrations that each fold holds out.
    """

    folder: Path
    demos: Demonstrations
    choice: Choice
    held_out: Sequence[Sequence[str]]


def known_demonstrations(spec: Spec) -> Demonstrations | None:
    """The demonstrations with the observations of every candidate; None where they are not collected yet."""
    return data.known_demonstrations(grid.wide(spec))


def check(spec: Spec, demos: Demonstrations | None = None) -> list[Candidate]:
    """Check every candidate and the folds, without collecting or training anything.

    :param demos: :func:`known_demonstrations`, where they have been read.
    :returns: the candidates.
    :raises SpecError: a candidate is not valid, or the grid is empty.
    :raises BadInput: there are fewer demonstrations than folds.
    """
    wide, own = grid.wide(spec), spec.demonstrations
    demos = data.outline(wide) if demos is None and data.in_file(wide) else demos
    candidates = grid.candidates(spec, data.dimensions(wide, demos))
    if demos is None:  # they will be collected
        assign([""] * (own.count - len(set(own.exclude))), spec.selection.folds, spec.seed)
    else:
        divide(demos, spec.selection.folds, spec.seed)
    return candidates


def select(
    spec: Spec,
    folder: str | Path,
    on_event: OnEvent = ignore,
    workers: Workers = ALL_CORES,
    demos: Demonstrations | None = None,
    resume: bool = True,
) -> Selection:
    """Score every candidate of the spec's grid in every fold, choose one, and write table and figure.

    Fits that the folder holds are not done again. The result depends on the spec and the demonstrations
    alone, not on workers or interruptions.

    >>> grid = "selection.grid.hierarchy.levels.0.count=[1, 2]"
    >>> spec = ddco_pyro.load_spec("mine.yaml", [grid, "selection.folds=2", "training.epochs=2"])
    >>> selection = ddco_pyro.select(spec, "runs/select")
    >>> len(selection.choice.rows)  # a row for each candidate
    2

    :param demos: :func:`known_demonstrations`, where they have been read.
    :param resume: whether a finished selection in the folder may be read again.
    :raises Failed: every candidate has failed in some fold.
    :raises BadInput: the folder holds something else, such as a selection by other demonstrations.
    :raises Busy: another process works on the folder.
    """
    folder = Path(folder)
    with claimed(folder, spec, resume):
        demos = demos or data.demonstrations(grid.wide(spec), on_event)
        record(folder, demos)
        folds = divide(demos, spec.selection.folds, spec.seed)
        held_out = [fold.masks["valid"] for fold in folds]
        write_text(folder / "folds.json", json_text({"folds": held_out}))
        candidates = grid.candidates(spec, Dimensions.of(demos, spec.control.relative_to))
        choice = choosing.choose(candidates, _fit_all(folder, folds, candidates, on_event, workers))
        tried = sum(map(len, held_out))
        found = {"folds": len(folds), "demonstrations": tried, "seed": spec.seed, **choosing.as_data(choice)}
        write_text(folder / "selection.md", choosing.markdown(choice, found))
        choosing.write_figure(choice, folder / "figures" / "selection.svg")
        write_text(folder / "selection.json", json_text(found))
    if choice.chosen is None:
        reasons = [reason for row in choice.rows for reason in row.failed.values()]
        raise Failed(f"every candidate has failed in some fold; the first reason: {reasons[0]}")
    return Selection(folder, demos, choice, held_out)


def _fit_all(
    folder: Path,
    folds: Sequence[Demonstrations],
    candidates: Sequence[Candidate],
    on_event: OnEvent,
    workers: Workers,
) -> dict[tuple[int, int], Metrics | str]:
    """The metrics of each candidate, by its number, in each fold; or why it failed there."""
    pairs = [(candidate.number, fold) for fold in range(len(folds)) for candidate in candidates]
    places = {pair: folder / "folds" / "{:03d}-{:02d}".format(*pair) for pair in pairs}
    found: dict[tuple[int, int], Metrics | str] = {
        pair: load(place, allow_code=True).metrics for pair, place in places.items() if is_finished(place)
    }
    on_event(CellsBegan("cross-validation", len(places), len(found)))
    left = [(pair, place) for pair, place in places.items() if pair not in found]
    calls = {pair: partial(_fitted, candidates[pair[0]].spec, folds[pair[1]], place) for pair, place in left}
    compile_all()
    with run_all(calls, workers, "trained a fold") as fitted:
        for pair, metrics in fitted:
            found[pair] = metrics
            failed = metrics if isinstance(metrics, str) else ""
            on_event(CellDone(f"{candidates[pair[0]].name}, fold {pair[1]}", failed))
    return dict(sorted(found.items()))


def _fitted(spec: Spec, demos: Demonstrations, folder: Path) -> Metrics | str:
    """The metrics of a fit to a fold's demonstrations, on one thread for equal bits; or why it failed.

    A failure does not stop other folds.
    """
    try:
        spec = with_overrides(spec, {"demonstrations.hold_out_by": None})  # masks alone say what is held out
        with one_thread():
            return fit_beside(model_name(spec), spec, data.seen(spec, demos), folder).metrics
    except Damaged:
        raise
    except Exception as error:
        return reason(error)


def final_spec(chosen: Candidate) -> Spec:
    """The spec of the final fit: the chosen candidate on all demonstrations but those that are set apart."""
    if chosen.spec.demonstrations.hold_out_by not in (None, EACH):
        return chosen.spec
    everything = {"demonstrations.hold_out_by": None, "demonstrations.valid_fraction": 0.0}
    return with_overrides(chosen.spec, everything)
