"""Confidence intervals of means and rates, paired tests, the edit score of segments, a hierarchy's worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from ddco_pyro.metrics import Against, Difference, Mean, Rate, Worth
from ddco_pyro.names import FLAT, MIXTURE

T = TypeVar("T")
V = TypeVar("V")

CONFIDENCE = 0.95
"""Level of intervals; a difference is significant where its interval excludes 0."""


def mean_interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """The 95 % t interval of the mean of a few values."""
    mean, count = float(np.mean(values)), len(values)
    half = float(np.std(values, ddof=1) * t_quantile(count - 1) / math.sqrt(count))
    return mean - half, mean + half


def t_quantile(freedom: float) -> float:
    """Half the width of a :data:`CONFIDENCE` interval in standard errors, for so many degrees of freedom."""
    from scipy.special import stdtrit  # most commands draw no interval

    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2))


def wider_interval(values: Sequence[float], error: float, trials: int) -> tuple[float, float]:
    """The wider of two 95 % t intervals of a mean: over training seeds, and over the trials of one fit.

    Seeds that give nearly the same fit have an interval without width, which is no evidence.

    :param values: the value of each seed.
    :param error: standard error over so many held-out demonstrations or episodes, 0 where it is not known.
    """
    mean = float(np.mean(values))
    half = max(mean_interval(values)[1] - mean, error * t_quantile(max(trials - 1, 1)))
    return mean - half, mean + half


def mean(values: np.ndarray) -> Mean:
    """A mean with its standard deviation and Student's 95 % interval; both None for less than two values."""
    trials = len(values)
    centre = float(values.mean()) if trials else None
    if trials < 2:
        return Mean(mean=centre, std=None, trials=trials, interval=None)
    return Mean(mean=centre, std=float(values.std(ddof=1)), trials=trials, interval=mean_interval(values))


def rate(successes: int, trials: int) -> Rate:
    """A success rate and its Wilson 95 % interval."""
    if trials == 0:
        return Rate(successes=0, trials=0, rate=None, interval=None)
    from scipy.stats import binomtest

    low, high = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    interval = (float(low), float(high))
    return Rate(successes=successes, trials=trials, rate=successes / trials, interval=interval)


def paired_difference(ours: Sequence[float], theirs: Sequence[float]) -> Against:
    """Successes from the same initial states: counts of one policy's alone, and McNemar's exact p-value."""
    from scipy.stats import binomtest

    only_ours = int(sum(a > b for a, b in zip(ours, theirs, strict=True)))
    only_theirs = int(sum(a < b for a, b in zip(ours, theirs, strict=True)))
    discordant = only_ours + only_theirs
    p_value = float(binomtest(only_ours, discordant).pvalue) if discordant else 1.0
    return Against(only_ours=only_ours, only_theirs=only_theirs, trials=len(ours), p_value=p_value)


def matching(counts: np.ndarray) -> np.ndarray:
    """The row that each column is matched with, one to one with the largest sum (Hungarian assignment).

    A column without a row has -1.

    >>> matching(np.array([[3, 4, 0], [0, 5, 0]])).tolist()
    [0, 1, -1]

    :param counts: what a row and a column have in common, such as steps.
    """
    from scipy.optimize import linear_sum_assignment

    match = np.full(counts.shape[1], -1)
    rows, columns = linear_sum_assignment(counts, maximize=True)
    match[columns] = rows
    return match


def edit_score(ours: np.ndarray, theirs: np.ndarray) -> float:
    """1 − Levenshtein distance of two sequences of segments / the longer one's length, of options [T].

    >>> edit_score(np.array([1, 1, 2, 1]), np.array([1, 2, 2, 2]))
    0.6666666666666667
    """
    first, second = (steps[np.flatnonzero(np.diff(steps, prepend=steps[0] - 1))] for steps in (ours, theirs))
    distances = np.arange(len(second) + 1)
    for number, segment in enumerate(first, 1):
        diagonal, distances[0] = distances[0], number
        for place, other in enumerate(second, 1):
            cost = min(distances[place] + 1, distances[place - 1] + 1, diagonal + (segment != other))
            diagonal, distances[place] = distances[place], cost
    return 1 - float(distances[-1]) / max(len(first), len(second))


# --- worth: several policies, and options that last ---------------------------------------------------------


def paired(ours: np.ndarray, theirs: np.ndarray, lengths: np.ndarray) -> Difference:
    """Difference in log-likelihood per step of two models on the same demonstrations, with standard error."""
    difference = ours - theirs
    mean = float(difference.sum() / lengths.sum())
    residual = difference - mean * lengths  # a ratio of sums: the error of its linearisation
    n = len(difference)
    error = float(np.sqrt(residual.var(ddof=1) * n) / lengths.sum()) if n > 1 else None
    return Difference(nats_per_step=mean, standard_error=error)


def worth(ours: str, values: Mapping[str, V], difference: Callable[[V, V], T]) -> Worth[T] | None:
    """Parts of a hierarchy's advantage, as paired differences (:func:`paired`, :func:`paired_difference`).

    ``memory`` is hierarchy − mixture: both have the same policies and gate, and in the hierarchy alone
    options last. ``experts`` is mixture − flat and ``total`` is hierarchy − flat, where there is a flat
    baseline, named in ``flat``.

    :param ours: the hierarchy's name.
    :param values: by name of a model: log p(ξ) of each demonstration, or success of each episode.
    :returns: None where ``values`` has no mixture, or the hierarchy is one.
    """
    if ours == MIXTURE or ours not in values or MIXTURE not in values:
        return None
    memory = difference(values[ours], values[MIXTURE])
    flat = next((name for name in FLAT if name in values), None)
    if flat is None:
        return Worth(memory=memory)
    experts, total = (difference(values[name], values[flat]) for name in (MIXTURE, ours))
    return Worth(memory=memory, experts=experts, total=total, flat=flat)
