"""Confidence intervals of means and rates, the paired test of successes, and the edit score of segments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

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


def mean(values: np.ndarray) -> dict[str, Any]:
    """A mean with its standard deviation and Student's 95 % interval; both are None for less than two values."""
    trials = len(values)
    centre = float(values.mean()) if trials else None
    if centre is None or trials < 2:
        return {"mean": centre, "std": None, "trials": trials, "interval": None}
    return {"mean": centre, "std": float(values.std(ddof=1)), "trials": trials, "interval": [*mean_interval(values)]}


def rate(successes: int, trials: int) -> dict[str, Any]:
    """A success rate and its Wilson 95 % interval."""
    if trials == 0:
        return {"successes": 0, "trials": 0, "rate": None, "interval": None}
    from scipy.stats import binomtest

    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return {
        "successes": successes,
        "trials": trials,
        "rate": successes / trials,
        "interval": [float(interval.low), float(interval.high)],
    }


def paired_difference(ours: Sequence[float], theirs: Sequence[float]) -> dict[str, Any]:
    """Successes from the same initial states: counts of those of one policy alone, and McNemar's exact p-value."""
    from scipy.stats import binomtest

    only_ours = int(sum(a > b for a, b in zip(ours, theirs, strict=True)))
    only_theirs = int(sum(a < b for a, b in zip(ours, theirs, strict=True)))
    discordant = only_ours + only_theirs
    p_value = float(binomtest(only_ours, discordant).pvalue) if discordant else 1.0
    return {"only_ours": only_ours, "only_theirs": only_theirs, "trials": len(ours), "p_value": p_value}


def edit_score(ours: np.ndarray, theirs: np.ndarray) -> float:
    """1 − Levenshtein distance of two sequences of segments / the longer one's length, of options [T] at each step.

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
