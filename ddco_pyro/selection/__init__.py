"""Selection by k-fold cross-validation (paper §4.3): any grid over the spec, the same folds for every candidate.

``selection.json`` has the result, ``folds/`` a file for each finished (candidate, fold), ``fit/`` the final fit, and
``demonstrations.json`` the digest of the demonstrations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import json_text, write_text
from ddco_pyro.errors import Failed
from ddco_pyro.events import CandidateGivenUp, FoldScored, OnEvent, SelectionBegan, ignore
from ddco_pyro.fitting.fitted_to import record
from ddco_pyro.fitting.run import claimed
from ddco_pyro.selection import choice as choosing
from ddco_pyro.selection import folds as dividing
from ddco_pyro.selection import grid, parallel, plot, scoring, table
from ddco_pyro.selection.choice import STOP_RULE, Choice
from ddco_pyro.selection.folds import Folds
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.selection.parallel import Workers
from ddco_pyro.selection.scoring import Score
from ddco_pyro.spec import Spec, with_overrides
from ddco_pyro.training import data as training_data
from ddco_pyro.training.data import demonstrations as read_demonstrations
from ddco_pyro.training.data import dimensions, in_file, outline

__all__ = ["Choice", "Selection", "SelectionFailed", "Workers", "check", "final_spec", "known_demonstrations", "select"]


HERE = Workers()
"""One process for each core of this machine."""


class SelectionFailed(Failed):
    """Nothing could be chosen."""


@dataclass(frozen=True)
class Selection:
    """A finished cross-validation, the folder it lives in, and the demonstrations, with all that a candidate sees."""

    folder: Path
    demos: Demonstrations
    choice: Choice
    folds: Folds


def known_demonstrations(spec: Spec) -> Demonstrations | None:
    """The demonstrations, with all that a candidate sees, where nothing has to be collected for them; else None."""
    return training_data.known_demonstrations(grid.wide(spec))


def check(spec: Spec, workers: Workers = HERE, demos: Demonstrations | None = None) -> list[Candidate]:
    """The candidates, all of them valid, without collecting or training anything.

    :param demos: :func:`known_demonstrations`, where they have been read.
    :raises SpecError: a candidate is not valid, or the grid is empty.
    :raises FoldError: there are fewer demonstrations than folds.
    :raises BackendError: the workers cannot be reached.
    """
    wide, own = grid.wide(spec), spec.demonstrations
    demos = outline(wide) if demos is None and in_file(wide) else demos
    candidates = grid.candidates(spec, dimensions(wide, demos))
    if demos is None:  # they will be collected
        dividing.assign(own.count - len(set(own.exclude)), spec.selection.folds, spec.seed)
    else:
        dividing.divide(demos, spec.selection.folds, spec.seed)
    workers.check()
    return candidates


def select(
    spec: Spec,
    folder: Path,
    on_event: OnEvent = ignore,
    workers: Workers = HERE,
    stop_early: bool = False,
    demos: Demonstrations | None = None,
    resume: bool = True,
) -> Selection:
    """Score every candidate of the spec's grid in every fold, choose, and write table and figure into the folder.

    What the folder has already is not done again. Which folds are scored depends on nothing but the spec, the
    demonstrations and ``stop_early``; neither on the workers nor on interruptions.

    :param demos: :func:`known_demonstrations`, where they have been read.
    :param resume: as of :func:`ddco_pyro.fitting.run.claim`.
    :raises SelectionFailed: every candidate has failed in some fold.
    :raises RunError: the folder holds something else.
    :raises OtherDemonstrations: it is a selection by other demonstrations.
    :raises Busy: another process is at work on the folder.
    """
    with claimed(folder, spec, resume):
        demos = demos or read_demonstrations(grid.wide(spec), on_event)
        record(folder, demos)
        return _select(spec, folder, demos, on_event, workers, stop_early)


def _select(
    spec: Spec, folder: Path, demos: Demonstrations, on_event: OnEvent, workers: Workers, stop_early: bool
) -> Selection:
    folds = dividing.divide(demos, spec.selection.folds, spec.seed)
    dividing.keep(folds, folder / "folds.json")
    work = _Work(folder, folds, grid.candidates(spec, folds.dimensions), on_event)
    work.load()
    with parallel.pool(workers) as pool:
        for numbers in _rounds(len(folds.held_out), stop_early):
            work.score(pool, numbers)
            if stop_early:
                work.give_up(numbers[-1])
    choice = choosing.choose(work.candidates, work.scores(), len(folds.held_out))
    _write(folder, spec, choice, folds, stop_early)
    if choice.chosen is None:
        reasons = [reason for row in choice.rows for reason in row.failed.values()]
        raise SelectionFailed(f"every candidate has failed in some fold; the first reason: {reasons[0]}")
    return Selection(folder, demos, choice, folds)


def final_spec(chosen: Candidate) -> Spec:
    """The spec of the fit that follows: what was chosen, on all demonstrations but those its file sets apart."""
    return with_overrides(chosen.spec, {"demonstrations.valid_fraction": 0.0})


def _rounds(folds: int, stop_early: bool) -> list[list[int]]:
    """Which folds are scored at a time: fold after fold where candidates can be given up in between."""
    return [[fold] for fold in range(folds)] if stop_early else [list(range(folds))]


@dataclass
class _Work:
    """What is to be scored, what has been, and who has been given up."""

    folder: Path
    folds: Folds
    candidates: Sequence[Candidate]
    on_event: OnEvent
    done: dict[tuple[int, int], Score] = field(default_factory=dict)
    stopped: set[int] = field(default_factory=set)

    def load(self) -> None:
        """Take what is kept from before."""
        for candidate in self.candidates:
            for fold in range(len(self.folds.held_out)):
                score = scoring.kept(self.folder, candidate.number, fold)
                if score is not None:
                    self.done[candidate.number, fold] = score
        self.on_event(SelectionBegan(len(self.candidates) * len(self.folds.held_out), len(self.done)))

    def score(self, pool: parallel.Parallel, folds: Sequence[int]) -> None:
        """Score what is missing in some folds, and keep each score as soon as it is there."""
        missing = [
            (candidate, fold)
            for fold in folds
            for candidate in self.candidates
            if candidate.number not in self.stopped and (candidate.number, fold) not in self.done
        ]
        if not missing:
            return
        for score in parallel.scores(pool, self.folds, missing):
            scoring.keep(self.folder, score)
            self.done[score.candidate, score.fold] = score
            self.on_event(FoldScored(self.candidates[score.candidate].name, score.fold, score.failed))

    def give_up(self, last: int) -> None:
        """Give up the candidates that are hopeless by their folds 0 to ``last``; later scores of theirs do not count,
        should there be some from before.
        """
        running = [candidate for candidate in self.candidates if candidate.number not in self.stopped]
        seen = [score for score in self.scores() if score.fold <= last and score.candidate not in self.stopped]
        for number in sorted(choosing.hopeless(running, seen)):
            later = [(number, fold) for fold in range(last + 1, len(self.folds.held_out))]
            missing = [key for key in later if self.done.pop(key, None) is None]
            self.on_event(CandidateGivenUp(self.candidates[number].name, len(missing)))
            self.stopped.add(number)

    def scores(self) -> list[Score]:
        """All scores, in the candidates' and folds' order."""
        return [self.done[key] for key in sorted(self.done)]


def _write(folder: Path, spec: Spec, choice: Choice, folds: Folds, stop_early: bool) -> None:
    data = {
        "folds": len(folds.held_out),
        "demonstrations": len(folds.demos),
        "seed": spec.seed,
        "stop_early": STOP_RULE if stop_early else None,
        **choosing.as_data(choice),
    }
    write_text(folder / "selection.md", table.markdown(choice, data))
    plot.write(choice, folder / "figures" / "selection.png")
    write_text(folder / "selection.json", json_text(data))
