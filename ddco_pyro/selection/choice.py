"""The choice among candidates by the one-standard-error rule, as data, a table and a figure.

One trained model scores all demonstrations held out in a fold, so their errors are not independent. Every standard
error here therefore counts a fold, not a demonstration, as one observation.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ddco_pyro.drawing.page import Page, Table, Text
from ddco_pyro.drawing.words import NAT, number, with_error
from ddco_pyro.metrics import Difference
from ddco_pyro.selection.folds import Score
from ddco_pyro.selection.grid import Candidate, point_name
from ddco_pyro.statistics import paired

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ddco_pyro.drawing.figures import Interval

RULE = (
    "chosen: the candidate with the fewest parameters within one standard error of the best, that is, with a mean "
    "held-out log-likelihood per step at most one standard error of the best's mean below it; the better one where "
    "parameters are equal. A candidate that failed in a fold is not chosen"
)

STD_NOTE = (
    "control.std differs between candidates: a fixed σ rescales the log-likelihood (each step has the terms "
    "−A log σ and −error²/2σ²), so between different σ most of a difference says how well σ fits the size of the "
    "errors, not how well the options explain the control; compare other fields at equal σ"
)


@dataclass(frozen=True)
class Row:
    """The result of one candidate; log-likelihoods in nats per step.

    :param mean: held-out log-likelihood per step over the scored folds, and its standard ``error``.
    :param difference: this minus the best over the folds of both.
    :param folds: log-likelihood per step of each scored fold, by number.
    :param failed: the reason, by number of the fold.
    :param gradient_steps: of a fold's training, on average; None where no fold was scored.
    :param unconverged: the folds whose training had not converged.
    """

    candidate: Candidate
    mean: float | None
    error: float | None
    difference: Difference | None
    folds: Mapping[int, float]
    failed: Mapping[int, str]
    gradient_steps: float | None = None
    unconverged: tuple[int, ...] = ()

    @property
    def status(self) -> str:
        """``scored``, or ``failed`` where a fold failed."""
        return "failed" if self.failed else "scored"


@dataclass(frozen=True)
class Choice:
    """All rows in the candidates' order; the ``best`` and the ``chosen`` row, None where every candidate failed."""

    rows: Sequence[Row]
    best: Row | None
    chosen: Row | None

    @property
    def notes(self) -> list[str]:
        """Caveats about the numbers."""
        stds = [row.candidate.spec.control.std for row in self.rows]
        return [*self._rising(), *([STD_NOTE] if any(std != stds[0] for std in stds) else [])]

    def _rising(self) -> Iterator[str]:
        """Of each number in the grid whose best value is the largest or the smallest: there may be better ones beyond.

        A single option has nothing below.
        """
        best = self.best
        for path, own in best.candidate.values.items() if best else ():
            values = {row.candidate.values[path] for row in self.rows if _is_number(row.candidate.values[path])}
            count = path.endswith(".count")
            if len(values) < 2 or own not in (min(values), max(values)) or (count and own == 1):
                continue
            which = "largest" if own == max(values) else "smallest"
            skills = "; likelihood does not count skills: it also rises where options divide a skill" if count else ""
            yield (
                f"{point_name({path: own})} is the best, and the {which} of the grid: the likelihood is still rising "
                f"there, so extend the grid (selection.grid.{path}){skills}"
            )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def choose(candidates: Sequence[Candidate], scores: Sequence[Score], folds: int) -> Choice:
    """The best candidate, and the candidate that the one-standard-error rule chooses.

    :param folds: how many folds a complete candidate has.
    """
    results = [_Scored(candidate, [s for s in scores if s.candidate == candidate.number]) for candidate in candidates]
    complete = [result for result in results if len(result.good) == folds]
    best = max(complete, key=lambda result: result.mean, default=None)
    reference = best or max((result for result in results if result.good), key=lambda result: result.mean, default=None)
    rows = [result.row(reference) for result in results]
    best_row = rows[best.candidate.number] if best else None
    within = [row for row in rows if within_one_error(row, best_row)]
    chosen = min(within, key=lambda row: (row.candidate.parameters, -(row.mean or 0.0)), default=None)
    return Choice(rows, best_row, chosen)


def within_one_error(row: Row, best: Row | None) -> bool:
    """Whether a candidate is complete and within one standard error of the best."""
    if row.status != "scored" or best is None or row.mean is None or best.mean is None or best.error is None:
        return False
    return best.mean - row.mean <= best.error


class _Scored:
    """The scores of one candidate by fold."""

    def __init__(self, candidate: Candidate, scores: Sequence[Score]) -> None:
        self.candidate = candidate
        by_fold = sorted(scores, key=lambda score: score.fold)
        self.good = {score.fold: score for score in by_fold if not score.failed}
        self.failed = {score.fold: score.failed for score in by_fold if score.failed}

    def arrays(self, folds: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Log-likelihood and steps of some folds."""
        chosen = [self.good[fold] for fold in folds]
        return np.array([score.total for score in chosen]), np.array([float(sum(score.steps)) for score in chosen])

    @property
    def mean(self) -> float:
        """Held-out log-likelihood per step."""
        values, steps = self.arrays(list(self.good))
        return float(values.sum() / steps.sum())

    def row(self, best: _Scored | None) -> Row:
        """The candidate's row, compared with the best."""
        if not self.good:
            return Row(self.candidate, None, None, None, {}, self.failed)
        values, steps = self.arrays(list(self.good))
        error = paired(values, np.zeros(len(values)), steps).standard_error
        per_fold = dict(zip(self.good, (values / steps).tolist(), strict=True))
        took = float(np.mean([score.gradient_steps for score in self.good.values()]))
        rising = tuple(fold for fold, score in self.good.items() if not score.converged)
        return Row(self.candidate, self.mean, error, self.against(best), per_fold, self.failed, took, rising)

    def against(self, best: _Scored | None) -> Difference | None:
        """Difference to another candidate per step, over the folds of both."""
        both = [fold for fold in self.good if best and fold in best.good]
        if best is None or len(both) < 2:
            return None
        (ours, steps), (theirs, _) = self.arrays(both), best.arrays(both)
        return paired(ours, theirs, steps)


def as_data(choice: Choice) -> dict[str, Any]:
    """The choice as plain data for ``selection.json``."""
    return {
        "rule": RULE,
        "notes": choice.notes,
        "best": choice.best.candidate.number if choice.best else None,
        "chosen": choice.chosen.candidate.number if choice.chosen else None,
        "candidates": [_row(row, choice.best) for row in choice.rows],
        "failed": [
            {"candidate": row.candidate.number, "name": row.candidate.name, "fold": fold, "reason": reason}
            for row in choice.rows
            for fold, reason in row.failed.items()
        ],
    }


def _row(row: Row, best: Row | None) -> dict[str, Any]:
    unknown = {"nats_per_step": None, "standard_error": None}
    return {
        "number": row.candidate.number,
        "name": row.candidate.name,
        "values": dict(row.candidate.values),
        "parameters": row.candidate.parameters,
        "status": row.status,
        "log_likelihood_per_step": row.mean,
        "standard_error": row.error,
        "difference": row.difference.model_dump() if row.difference else unknown,
        "within_one_standard_error": within_one_error(row, best),
        "gradient_steps": row.gradient_steps,
        "not_converged": len(row.unconverged),
        "folds": [{"fold": fold, "log_likelihood_per_step": value} for fold, value in row.folds.items()],
    }


def table(choice: Choice, title: str | None = None) -> Table:
    """A row for each candidate."""
    head = ["Candidate", "Parameters", "Held-out nats/step", "Minus the best", "Gradient steps", "Folds", ""]
    return Table(head, [_cells(row, choice) for row in choice.rows], {0, 6}, title)


def _cells(row: Row, choice: Choice) -> list[str]:
    mean = "–" if row.mean is None else f"{number(row.mean, 3)} ± {number(row.error, 3)}"
    difference = with_error(None if row is choice.best else row.difference, 3)
    marks = [name for name, marked in (("best", choice.best), ("chosen", choice.chosen)) if marked is row]
    marks += [] if row.status == "scored" else [row.status]
    marks += [f"not converged in {len(row.unconverged)}"] if row.unconverged else []
    took = [number(row.gradient_steps, 0), str(len(row.folds))]
    return [row.candidate.name, str(row.candidate.parameters), mean, difference, *took, ", ".join(marks)]


def markdown(choice: Choice, data: Mapping[str, Any]) -> str:
    """Table, rule, failed folds and notes.

    :param data: the contents of ``selection.json``.
    """
    intro = (
        f"{data['folds']}-fold cross-validation over {data['demonstrations']} demonstrations, with the same folds for "
        f"every candidate. Log-likelihood in nats: {NAT}. ± is one standard error over the folds; gradient steps are "
        "the mean of a fold."
    )
    lines = [data["rule"] + "."]
    lines += [f"**Failed:** {one['name']}, fold {one['fold']}: {one['reason']}" for one in data["failed"]]
    lines += [f"**Note:** {note}." for note in choice.notes]
    return Page("Selection", [Text(intro), table(choice), *map(Text, lines)], []).markdown()


def write_figure(choice: Choice, path: Path) -> None:
    """Draw the choice as PNG; nothing where no candidate was scored."""
    if any(row.mean is not None for row in choice.rows):
        from ddco_pyro.drawing.figures import save, style

        with style():
            save(draw(choice), path, "Held-out log-likelihood of each candidate, and paired differences to the best")


def draw(choice: Choice) -> Figure:
    """Log-likelihood of each candidate with the band of one standard error below the best, and paired differences."""
    from ddco_pyro.drawing.figures import ACCENT, FAINT, INK, Interval, Panel, interval_plot

    best, band = choice.best, None
    if best and best.mean is not None and best.error is not None:
        band = (best.mean - best.error, best.mean)
    means: list[Interval | None] = []
    differences: list[Interval | None] = []
    for row in choice.rows:
        looks: dict[str, Any] = {
            "marker": "D" if row is best else "s" if row is choice.chosen else "o",
            "colour": ACCENT if row is choice.chosen else INK if row.status == "scored" else FAINT,
        }
        best_folds = best.folds if best else {}
        each = [value - best_folds[fold] for fold, value in row.folds.items() if fold in best_folds]
        points = list(row.folds.values())
        means.append(None if row.mean is None else Interval.around(row.mean, row.error, points, **looks))
        differences.append(Interval.of(row.difference, each, **looks))
    panels = [
        Panel("Each candidate, ± one standard error", "held-out log-likelihood (nats per step)", means, band=band),
        Panel("Minus the best, ± one standard error", "nats per step above the best, same folds", differences, line=0),
    ]
    marks = (
        "diamond: best; orange: chosen, the smallest within one standard error of the best (band); dots: single folds"
    )
    notes = [line for note in choice.notes for line in textwrap.wrap(f"Note: {note}.", 150)]
    names = [
        f"{row.candidate.name} ({row.candidate.parameters} parameters){' (failed)' if row.failed else ''}"
        for row in choice.rows
    ]
    return interval_plot(names, panels, [marks, *notes])
