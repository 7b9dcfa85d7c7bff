"""Statistics of results over training seeds, nested in tasks: intervals, one-sided tests, and Holm's correction.

Several tasks are the sample: an interval speaks of further tasks, and its unit is a task's mean over seeds. With a
single task the training seeds are the sample. Fits share neither demonstrations nor starts across seeds, so no test
pools their episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

LEVEL = 0.025
"""One-sided level of the tests, which corresponds to two-sided 95 % intervals."""

BySeed = Mapping[str, Mapping[Any, float]]
"""Values by task and training seed."""


@dataclass(frozen=True)
class Estimate:
    """A mean over tasks of means over seeds.

    :param error: the standard error; NaN for a single unit, as the interval is.
    :param freedom: degrees of freedom of the t interval: tasks − 1, or seeds − 1 for a single task.
    :param interval: the 95 % t interval.
    :param units: the means of the tasks, or the values of the seeds of a single task.
    """

    value: float
    error: float
    freedom: int
    interval: tuple[float, float]
    units: tuple[float, ...]

    @property
    def range(self) -> tuple[float, float]:
        """The least and the greatest unit."""
        return min(self.units), max(self.units)


def paired(ours: BySeed, theirs: BySeed) -> dict[str, dict[Any, float]]:
    """Differences by task and seed, where both have a value.

    >>> paired({"push": {0: 0.75, 1: 0.5}}, {"push": {0: 0.5}})
    {'push': {0: 0.25}}
    """
    both = {
        task: {seed: value - theirs[task][seed] for seed, value in own.items() if seed in theirs[task]}
        for task, own in ours.items()
        if task in theirs
    }
    return {task: own for task, own in both.items() if own}


def estimate(values: BySeed) -> Estimate:
    """The mean and its t interval.

    >>> found = estimate({"push": {0: 1.0, 1: 2.0, 2: 3.0}})
    >>> found.value, found.freedom, round(found.interval[0], 3)
    (2.0, 2, -0.484)

    :raises ValueError: there are no values.
    """
    from scipy.special import stdtrit

    by_task = [np.array(list(own.values()), float) for own in values.values()]
    means = np.array([own.mean() for own in by_task])
    units = means if len(means) > 1 else by_task[0]
    value, freedom = float(means.mean()), len(units) - 1
    error = float(units.std(ddof=1) / math.sqrt(len(units))) if freedom else math.nan
    half = error * float(stdtrit(freedom, 1 - LEVEL)) if freedom else math.nan
    return Estimate(value, error, freedom, (value - half, value + half), tuple(map(float, units)))


def bootstrap(values: BySeed, draws: int = 4000, seed: int = 0) -> tuple[float, float]:
    """The 95 % percentile interval of a bootstrap that draws tasks, and seeds within each task.

    With few tasks or seeds the interval is too short: t is the test, and the bootstrap stands beside it.

    >>> [round(end, 1) for end in bootstrap({"push": {0: 1.0, 1: 2.0, 2: 3.0}})]
    [1.0, 3.0]
    """
    random, by_task = np.random.default_rng(seed), [list(own.values()) for own in values.values()]
    lengths = np.array([len(own) for own in by_task])
    padded = np.array([own + [0.0] * (lengths.max() - len(own)) for own in by_task])
    tasks = random.integers(len(by_task), size=(draws, len(by_task)))
    there = np.arange(lengths.max()) < lengths[tasks][..., None]
    seeds = (random.random(there.shape) * lengths[tasks][..., None]).astype(int)
    drawn = np.where(there, padded[tasks[..., None], seeds], 0).sum(-1) / lengths[tasks]
    low, high = np.quantile(drawn.mean(-1), [LEVEL, 1 - LEVEL])
    return float(low), float(high)


def p_value(found: Estimate, bound: float) -> float:
    """The one-sided p-value of the t test of "the mean is at most ``bound``"; NaN for a single unit.

    Superiority by a margin has the bound +margin, non-inferiority −margin.
    """
    from scipy.special import stdtr

    if not found.freedom:
        return math.nan
    if found.error == 0:
        return 0.0 if found.value > bound else 1.0
    return float(stdtr(found.freedom, (bound - found.value) / found.error))


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's adjusted p-values, in the given order; a NaN counts as 1.

    >>> [round(p, 6) for p in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    known = np.nan_to_num(np.array(p_values, float), nan=1.0)
    order, most, adjusted = np.argsort(known, kind="stable"), 0.0, known.copy()
    for rank, place in enumerate(order):
        most = max(most, min(1.0, (len(known) - rank) * known[place]))
        adjusted[place] = most
    return [float(p) for p in adjusted]
