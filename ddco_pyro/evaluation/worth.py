"""What a hierarchy is worth over a flat policy, in two parts: several experts, and options that last."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.evaluation.analysis import paired

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
    if ours == MIXTURE or MIXTURE not in values:
        return {}
    steps = np.array(lengths, dtype=float)
    flat = next((name for name in FLAT if name in values), None)
    pairs = {"memory": (ours, MIXTURE)}
    if flat is not None:
        pairs |= {"experts": (MIXTURE, flat), "total": (ours, flat)}
    differences = {name: paired(values[one], values[other], steps) for name, (one, other) in pairs.items()}
    return differences | ({} if flat is None else {"flat": flat})


def mean_run(choices: Sequence[np.ndarray]) -> float:
    """Mean number of steps in a row with one choice, over sequences of choices [T]."""
    runs = sum(1 + int(np.count_nonzero(np.diff(sequence))) for sequence in choices)
    return sum(map(len, choices)) / runs
