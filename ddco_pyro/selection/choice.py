"""From the scores of all folds to a choice: paired differences, their standard errors, the one-standard-error rule.

The demonstrations held out in one fold are scored by one trained model, so their errors go together: a fold, and not
a demonstration, counts as one observation in every standard error here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from ddco_pyro.evaluation.analysis import paired
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.selection.scoring import Score

RULE = (
    "chosen: the fewest parameters among the candidates whose mean held-out log-likelihood per step is at most one "
    "standard error of the best's mean below it (the better one where parameters are equal); a candidate with a failed "
    "fold, or one that was stopped early, is not chosen"
)

STOP_FOLDS = 3
STOP_LEVEL = 0.001
STOP_RULE = (
    f"--stop-early: after each fold from the {STOP_FOLDS}rd on, a candidate is given up where the paired t-test over "
    f"the folds so far puts it below the best so far (one-sided, p < {STOP_LEVEL}), or where a fold of it has failed"
)

STD_NOTE = (
    "control.std differs between candidates: a fixed σ rescales the log-likelihood (each step has the terms "
    "−A log σ and −error²/2σ²), so between different σ most of a difference says how well σ fits the size of the "
    "errors, not how well the options explain the control; compare other fields at equal σ"
)


@dataclass(frozen=True)
class Row:
    """One candidate's result; log-likelihoods in nats per step.

    :param status: ``scored``; ``failed`` where a fold has failed; ``stopped`` where it was given up early.
    :param mean: held-out log-likelihood per step over the folds that were scored, and its standard ``error``.
    :param difference: this minus the best over the folds that both have, and its standard error.
    :param folds: log-likelihood per step of each fold that was scored, by number.
    :param failed: why, by number of the fold.
    :param gradient_steps: of a fold's training, on average; None where none was scored.
    :param unconverged: the folds whose training had not converged when its budget ended.
    """

    candidate: Candidate
    status: str
    mean: float | None
    error: float | None
    difference: tuple[float, float] | None
    folds: Mapping[int, float]
    failed: Mapping[int, str]
    gradient_steps: float | None = None
    unconverged: tuple[int, ...] = ()


@dataclass(frozen=True)
class Choice:
    """All rows in the candidates' order; the ``best`` and the ``chosen`` row, None where every candidate failed."""

    rows: Sequence[Row]
    best: Row | None
    chosen: Row | None

    @property
    def notes(self) -> list[str]:
        """What has to be known to read the numbers."""
        return [STD_NOTE] if std_varies([row.candidate for row in self.rows]) else []


def std_varies(candidates: Sequence[Candidate]) -> bool:
    """Whether candidates differ in σ."""
    stds = [candidate.spec.control.std for candidate in candidates]
    return any(std != stds[0] for std in stds)


def choose(candidates: Sequence[Candidate], scores: Sequence[Score], folds: int) -> Choice:
    """The best candidate and the one that the one-standard-error rule chooses.

    :param folds: how many folds a candidate needs to have been scored in.
    """
    results = [_Scored(candidate, [s for s in scores if s.candidate == candidate.number]) for candidate in candidates]
    complete = [result for result in results if len(result.good) == folds]
    best = max(complete, key=lambda result: result.mean, default=None)
    reference = best or max((result for result in results if result.good), key=lambda result: result.mean, default=None)
    rows = [result.row(folds, reference) for result in results]
    best_row = rows[best.candidate.number] if best else None
    within = [row for row in rows if within_one_error(row, best_row)]
    chosen = min(within, key=lambda row: (row.candidate.parameters, -(row.mean or 0.0)), default=None)
    return Choice(rows, best_row, chosen)


def within_one_error(row: Row, best: Row | None) -> bool:
    """Whether a candidate is complete, and its mean at most one standard error of the best's mean below that."""
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

    def row(self, folds: int, best: _Scored | None) -> Row:
        """Its row, compared with the best."""
        status = "failed" if self.failed else "scored" if len(self.good) == folds else "stopped"
        if not self.good:
            return Row(self.candidate, status, None, None, None, {}, self.failed)
        values, steps = self.arrays(list(self.good))
        own = paired(values, np.zeros(len(values)), steps)
        per_fold = dict(zip(self.good, (values / steps).tolist(), strict=True))
        took = float(np.mean([score.gradient_steps for score in self.good.values()]))
        rising = tuple(fold for fold, score in self.good.items() if not score.converged)
        error, difference = _finite(own["standard_error"]), self.against(best)
        return Row(self.candidate, status, self.mean, error, difference, per_fold, self.failed, took, rising)

    def against(self, best: _Scored | None) -> tuple[float, float] | None:
        """Difference to another candidate per step and its standard error, over the folds that both have."""
        both = [fold for fold in self.good if best and fold in best.good]
        if best is None or len(both) < 2:
            return None
        (ours, steps), (theirs, _) = self.arrays(both), best.arrays(both)
        margin = paired(ours, theirs, steps)
        return margin["nats_per_step"], margin["standard_error"]


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def hopeless(candidates: Sequence[Candidate], scores: Sequence[Score]) -> set[int]:
    """Numbers of the candidates to give up after some folds, by :data:`STOP_RULE`."""
    failed = {score.candidate for score in scores if score.failed}
    results = [_Scored(candidate, [s for s in scores if s.candidate == candidate.number]) for candidate in candidates]
    results = [result for result in results if result.candidate.number not in failed]
    best = max(results, key=lambda result: result.mean, default=None)
    if best is None or len(best.good) < STOP_FOLDS:
        return failed
    return failed | {result.candidate.number for result in results if result is not best and _below(result, best)}


def _below(result: _Scored, best: _Scored) -> bool:
    (ours, steps), (theirs, _) = result.arrays(list(result.good)), best.arrays(list(result.good))
    difference = (ours - theirs) / steps
    if np.ptp(difference) == 0:
        return bool(difference[0] < 0)
    return bool(stats.ttest_1samp(difference, 0, alternative="less").pvalue < STOP_LEVEL)


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
    mean, error = row.difference or (None, None)
    return {
        "number": row.candidate.number,
        "name": row.candidate.name,
        "values": dict(row.candidate.values),
        "parameters": row.candidate.parameters,
        "status": row.status,
        "log_likelihood_per_step": row.mean,
        "standard_error": row.error,
        "difference": {"nats_per_step": mean, "standard_error": error},
        "within_one_standard_error": within_one_error(row, best),
        "gradient_steps": row.gradient_steps,
        "not_converged": len(row.unconverged),
        "folds": [{"fold": fold, "log_likelihood_per_step": value} for fold, value in row.folds.items()],
    }
