"""The advantage of a hierarchy over a flat policy in two parts: several policies, and options that last."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.metrics import Difference, SuccessWorth, Worth
from ddco_pyro.names import FLAT, MIXTURE
from ddco_pyro.statistics import paired_difference


def paired(ours: np.ndarray, theirs: np.ndarray, lengths: np.ndarray) -> Difference:
    """Difference in log-likelihood per step between two models on the same demonstrations, with its standard error."""
    difference = ours - theirs
    mean = float(difference.sum() / lengths.sum())
    residual = difference - mean * lengths  # a ratio of sums: the error of its linearisation
    n = len(difference)
    error = float(np.sqrt(residual.var(ddof=1) * n) / lengths.sum()) if n > 1 else None
    return Difference(nats_per_step=mean, standard_error=error)


def worth(ours: str, values: Mapping[str, np.ndarray], lengths: Sequence[int]) -> Worth | None:
    """The parts of a hierarchy's advantage in held-out log-likelihood per step, as paired differences.

    ``memory`` is hierarchy − mixture: both have the same policies and gate, and in the hierarchy alone options last.
    ``experts`` is mixture − flat and ``total`` is hierarchy − flat, where there is a flat baseline, named in ``flat``.

    :param ours: the hierarchy's name.
    :param values: log p(ξ) of each demonstration under each model, nats, [N], by name.
    :param lengths: steps of each demonstration, [N].
    :returns: None where ``values`` has no mixture, or the hierarchy is one.
    """
    steps = np.array(lengths, dtype=float)
    parts = _parts(ours, values, lambda one, other: paired(one, other, steps))
    return Worth(**parts) if parts else None


def success_worth(ours: str, successes: Mapping[str, Sequence[float]]) -> SuccessWorth | None:
    """The same parts for success in rollouts (:func:`ddco_pyro.statistics.paired_difference`).

    :param successes: success (1) or not (0) of each episode, by method.
    """
    parts = _parts(ours, successes, paired_difference)
    return SuccessWorth(**parts) if parts else None


def _parts(ours: str, values: Mapping[str, Any], difference: Callable[[Any, Any], Any]) -> dict[str, Any]:
    if ours == MIXTURE or ours not in values or MIXTURE not in values:
        return {}
    flat = next((name for name in FLAT if name in values), None)
    pairs = {"memory": (ours, MIXTURE)}
    if flat is not None:
        pairs |= {"experts": (MIXTURE, flat), "total": (ours, flat)}
    return {name: difference(values[one], values[other]) for name, (one, other) in pairs.items()} | {"flat": flat}


def mean_run(choices: Sequence[np.ndarray]) -> float:
    """Mean number of steps in a row with one choice, over sequences of choices [T]."""
    runs = sum(1 + int(np.count_nonzero(np.diff(sequence))) for sequence in choices)
    return sum(map(len, choices)) / runs
