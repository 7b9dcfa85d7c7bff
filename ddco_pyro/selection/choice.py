"""The choice among candidates by the one-standard-error rule, as data, a table and a figure.

One trained model scores all demonstrations held out in a fold, so their errors are not independent. Every
standard error here therefore counts a fold, not a demonstration, as one observation.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.drawing.figures import ACCENT, FAINT, INK, Interval, Panel, interval_plot, save
from ddco_pyro.drawing.page import Page, Table, Text
from ddco_pyro.drawing.words import NAT, number, with_error
from ddco_pyro.metrics import Difference, Metrics
from ddco_pyro.selection.grid import Candidate, point_name
from ddco_pyro.statistics import paired

RULE = (
    "chosen: the candidate with the fewest parameters within one standard error of the best, that is, with a "
    "mean held-out log-likelihood per step at most one standard error of the best's mean below it; the "
    "better one where parameters are equal. A candidate that failed in a fold is not chosen"
)

STD_NOTE = (
    "control.std differs between candidates: a fixed σ rescales the log-likelihood (each step has the terms "
    "−A log σ and −error²/2σ²), so between different σ most of a difference says how well σ fits the size of "
    "the errors, not how well the options explain the control; compare other fields at equal σ"
)


@dataclass(frozen=True)
class Row:
    """The fits of one candidate; log-likelihoods in nats per step.

    :param fits: the metrics of each fold's fit, by number of the fold.
    :param failed: why there is no fit, by number of the fold.
    :param difference: this minus the best over the folds of both.
    """

    candidate: Candidate
    fits: Mapping[int, Metrics]
    failed: Mapping[int, str]
    difference: Difference | None = None

    def arrays(self, folds: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """Held-out log-likelihood in nats, and steps, of some folds."""
        held_out = [self.fits[fold].valid for fold in folds]
        totals = [math.fsum(demo.log_likelihood for demo in demos) for demos in held_out]
        return np.array(totals), np.array([float(sum(demo.steps for demo in demos)) for demos in held_out])

    @property
    def folds(self) -> dict[int, float]:
        """Held-out log-likelihood per step of each fold, by its number."""
        values, steps = self.arrays(self.fits)
        return dict(zip(self.fits, (values / steps).tolist(), strict=True))

    @property
    def mean(self) -> float | None:
        """Held-out log-likelihood per step over the folds; None where none has a fit."""
        values, steps = self.arrays(self.fits)
        return float(values.sum() / steps.sum()) if self.fits else None

    @property
    def error(self) -> float | None:
        """The standard error of the mean; None with fewer than two fits."""
        values, steps = self.arrays(self.fits)
        return paired(values, np.zeros(len(values)), steps).standard_error if self.fits else None

    @property
    def gradient_steps(self) -> float | None:
        """Of a fold's training, on average."""
        steps = [fit.training.spent.gradient_steps or 0 for fit in self.fits.values()]
        return float(np.mean(steps)) if steps else None

    @property
    def unconverged(self) -> list[int]:
        """The folds whose training had not converged."""
        return [fold for fold, fit in self.fits.items() if not fit.training.converged]

    def minus(self, best: Row | None) -> Row:
        """This row with its difference to the best."""
        both = [fold for fold in self.fits if best and fold in best.fits]
        if best is None or len(both) < 2:
            return self
        (ours, steps), (theirs, _) = self.arrays(both), best.arrays(both)
        return replace(self, difference=paired(ours, theirs, steps))


@dataclass(frozen=True)
class Choice:
    """All rows in the candidates' order; the ``best`` and the ``chosen`` row, None where all failed."""

    rows: Sequence[Row]
    best: Row | None
    chosen: Row | None

    @property
    def notes(self) -> list[str]:
        """Caveats about the numbers."""
        stds = [row.candidate.spec.control.std for row in self.rows]
        return [*self._rising(), *([STD_NOTE] if any(std != stds[0] for std in stds) else [])]

    def _rising(self) -> Iterator[str]:
        """Of each number in the grid with the best value at an end: there may be better ones beyond.

        A single option has nothing below.
        """
        best = self.best
        for path, own in best.candidate.values.items() if best else ():
            values = {value for row in self.rows if type(value := row.candidate.values[path]) in (int, float)}
            count = path.endswith(".count")
            if len(values) < 2 or own not in (min(values), max(values)) or (count and own == 1):
                continue
            which = "largest" if own == max(values) else "smallest"
            divided = "; likelihood does not count skills: it also rises where options divide a skill"
            skills = divided if count else ""
            yield (
                f"{point_name({path: own})} is the best, and the {which} of the grid: the likelihood is "
                f"still rising there, so extend the grid (selection.grid.{path}){skills}"
            )


def choose(candidates: Sequence[Candidate], fits: Mapping[tuple[int, int], Metrics | str]) -> Choice:
    """The best candidate, and the candidate that the one-standard-error rule chooses.

    :param fits: by the number of the candidate and of the fold, all of it: metrics, or why there are none.
    """
    rows = []
    for candidate in candidates:
        own = {fold: fit for (number, fold), fit in fits.items() if number == candidate.number}
        done = {fold: fit for fold, fit in own.items() if not isinstance(fit, str)}
        rows.append(Row(candidate, done, {fold: why for fold, why in own.items() if isinstance(why, str)}))
    scored = [row for row in rows if row.fits]
    complete = [row for row in scored if not row.failed]
    reference = max(complete or scored, key=lambda row: row.mean or 0.0, default=None)
    rows = [row.minus(reference) for row in rows]
    likeliest = reference.candidate if complete and reference else None
    best = next((row for row in rows if row.candidate is likeliest), None)
    within = [row for row in rows if within_one_error(row, best)]
    chosen = min(within, key=lambda row: (row.candidate.parameters, -(row.mean or 0.0)), default=None)
    return Choice(rows, best, chosen)


def within_one_error(row: Row, best: Row | None) -> bool:
    """Whether a candidate is complete and within one standard error of the best."""
    if row.failed or best is None or row.mean is None or best.mean is None or best.error is None:
        return False
    return best.mean - row.mean <= best.error


def as_data(choice: Choice) -> dict[str, Any]:
    """The choice as plain data for ``selection.json``."""
    none = {"nats_per_step": None, "standard_error": None}
    return {
        "rule": RULE,
        "notes": choice.notes,
        "best": choice.best.candidate.number if choice.best else None,
        "chosen": choice.chosen.candidate.number if choice.chosen else None,
        "candidates": [
            {
                "number": row.candidate.number,
                "name": row.candidate.name,
                "values": dict(row.candidate.values),
                "parameters": row.candidate.parameters,
                "status": "failed" if row.failed else "scored",
                "log_likelihood_per_step": row.mean,
                "standard_error": row.error,
                "difference": row.difference.model_dump() if row.difference else none,
                "within_one_standard_error": within_one_error(row, choice.best),
                "gradient_steps": row.gradient_steps,
                "not_converged": len(row.unconverged),
                "folds": [{"fold": n, "log_likelihood_per_step": value} for n, value in row.folds.items()],
            }
            for row in choice.rows
        ],
        "failed": [
            {"candidate": row.candidate.number, "name": row.candidate.name, "fold": fold, "reason": reason}
            for row in choice.rows
            for fold, reason in row.failed.items()
        ],
    }


def table(choice: Choice, title: str | None = None) -> Table:
    """A row for each candidate."""
    rows = []
    for row in choice.rows:
        mean = "–" if row.mean is None else f"{number(row.mean, 3)} ± {number(row.error, 3)}"
        difference = with_error(None if row is choice.best else row.difference, 3)
        marks = [name for name, marked in (("best", choice.best), ("chosen", choice.chosen)) if marked is row]
        marks += ["failed"] if row.failed else []
        marks += [f"not converged in {len(row.unconverged)}"] if row.unconverged else []
        first = [row.candidate.name, str(row.candidate.parameters), mean, difference]
        rows.append([*first, number(row.gradient_steps, 0), str(len(row.folds)), ", ".join(marks)])
    head = ["Candidate", "Parameters", "Held-out nats/step", "Minus the best", "Gradient steps", "Folds", ""]
    return Table(head, rows, {0, 6}, title)


def markdown(choice: Choice, data: Mapping[str, Any]) -> str:
    """Table, rule, failed folds and notes.

    :param data: the contents of ``selection.json``.
    """
    intro = (
        f"{data['folds']}-fold cross-validation over {data['demonstrations']} demonstrations, with the same "
        f"folds for every candidate. Log-likelihood in nats: {NAT}. ± is one standard error over the folds; "
        "gradient steps are the mean of a fold."
    )
    lines = [data["rule"] + "."]
    lines += [f"**Failed:** {one['name']}, fold {one['fold']}: {one['reason']}" for one in data["failed"]]
    lines += [f"**Note:** {note}." for note in choice.notes]
    return Page("Selection", [Text(intro), table(choice), *map(Text, lines)], []).markdown()


def write_figure(choice: Choice, path: Path) -> None:
    """Draw log-likelihoods and paired differences of candidates as SVG; nothing where none was scored.

    A band ends one standard error below the best.
    """
    if all(row.mean is None for row in choice.rows):
        return
    best, band = choice.best, None
    if best and best.mean is not None and best.error is not None:
        band = (best.mean - best.error, best.mean)
    means: list[Interval | None] = []
    differences: list[Interval | None] = []
    for row in choice.rows:
        colour = ACCENT if row is choice.chosen else FAINT if row.failed else INK
        best_folds = best.folds if best else {}
        each = [value - best_folds[fold] for fold, value in row.folds.items() if fold in best_folds]
        points = list(row.folds.values())
        means.append(None if row.mean is None else Interval.around(row.mean, row.error, points, colour))
        differences.append(None if row.difference is None else Interval.of(row.difference, each, colour))
    likelihood = "held-out log-likelihood (nats per step)"
    above = "nats per step above the best, same folds"
    panels = [
        Panel("Each candidate, ± one standard error", likelihood, means, band=band),
        Panel("Minus the best, ± one standard error", above, differences, line=0),
    ]
    marks = "orange: chosen, the smallest within one standard error of the best (band); dots: single folds"
    notes = [line for note in choice.notes for line in textwrap.wrap(f"Note: {note}.", 150)]
    names = [
        f"{row.candidate.name} ({row.candidate.parameters} parameters){' (failed)' if row.failed else ''}"
        for row in choice.rows
    ]
    alt = "Held-out log-likelihood of each candidate, and paired differences to the best"
    save(interval_plot(names, panels, alt, [marks, *notes]), path)
