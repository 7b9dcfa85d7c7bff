"""What a hierarchy is worth over a flat policy, in two parts: several experts, and options that last."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.evaluation.analysis import paired
from ddco_pyro.simulation.episodes import paired_difference

MIXTURE = "mixture"
FLAT = ("flat", "flat_equal")
"""The policies without options that a hierarchy is measured against; the first that is there."""


def worth(ours: str, values: Mapping[str, np.ndarray], lengths: Sequence[int]) -> dict[str, Any]:
    """The paired differences in held-out log-likelihood per step that say what the hierarchy is worth.

    ``memory`` is hierarchy − mixture: the same experts and gate, which differ in options that last alone. ``experts``
    is mixture − flat, and ``total`` their sum; both are there where a flat policy is, named in ``flat``.

    :param ours: the hierarchy's name.
    :param values: log p(ξ) of each demonstration under each model, nats, [N], by name.
    :param lengths: steps of each demonstration, [N].
    :returns: nothing where ``values`` has no mixture, or the hierarchy is one.
    """
    steps = np.array(lengths, dtype=float)
    return _parts(ours, values, lambda one, other: paired(one, other, steps))


def success_worth(ours: str, successes: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """The same parts of the success in rollouts from the same initial states, each by
    :func:`ddco_pyro.simulation.episodes.paired_difference`.

    :param successes: success (1) or not (0) of each episode, by method.
    """
    return _parts(ours, successes, paired_difference)


def _parts(ours: str, values: Mapping[str, Any], difference: Callable[[Any, Any], dict[str, Any]]) -> dict[str, Any]:
    if ours == MIXTURE or ours not in values or MIXTURE not in values:
        return {}
    flat = next((name for name in FLAT if name in values), None)
    pairs = {"memory": (ours, MIXTURE)}
    if flat is not None:
        pairs |= {"experts": (MIXTURE, flat), "total": (ours, flat)}
    found = {name: difference(values[one], values[other]) for name, (one, other) in pairs.items()}
    return found | ({} if flat is None else {"flat": flat})


def mean_run(choices: Sequence[np.ndarray]) -> float:
    """Mean number of steps in a row with one choice, over sequences of choices [T]."""
    runs = sum(1 + int(np.count_nonzero(np.diff(sequence))) for sequence in choices)
    return sum(map(len, choices)) / runs
