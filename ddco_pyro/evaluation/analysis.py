"""What a fitted hierarchy says about demonstrations: who is active when, for how long, and how differently options
act.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference import Posterior
from ddco_pyro.model.outputs import CallerOutputs, Outputs


@dataclass(frozen=True)
class OptionUse:
    """How one choice of a level (0 is control) is used over all steps of some demonstrations.

    :param share: mean of u_t, the part of the time it is active.
    :param selected: Σ v_t, how often it is selected.
    :param demonstrations: in how many demonstrations it is selected: the sum over them of min(1, Σ v_t).
    :param duration: expected steps from a selection to the next, Σ u_t / Σ v_t; None where it is never selected.
    """

    choice: int
    share: float
    selected: float
    demonstrations: float
    duration: float | None


def option_use(posterior: Posterior) -> list[list[OptionUse]]:
    """For each level, lowest first, the use of every choice."""
    uses = []
    for u, v in zip(posterior.u, posterior.v, strict=True):
        active, selected = u.sum((0, 1)).numpy(), v.sum(1).numpy()
        total = float(active.sum())
        uses.append([_use(choice, float(active[choice]), selected[:, choice], total) for choice in range(len(active))])
    return uses


def _use(choice: int, active: float, selected: np.ndarray, total: float) -> OptionUse:
    """One choice that is ``active`` in so many of ``total`` steps, and ``selected`` so often in each demonstration."""
    often = float(selected.sum())
    duration = active / often if often > 1e-6 else None
    return OptionUse(choice, active / total, often, float(selected.clip(max=1.0).sum()), duration)


def as_rows(use: Sequence[Sequence[OptionUse]]) -> list[list[dict[str, float | int | None]]]:
    """The same as plain data."""
    return [[asdict(choice) for choice in level] for level in use]


def divergences(pieces: Iterable[tuple[Outputs, Posterior]]) -> list[list[dict[str, Any]]]:
    """How differently each two ``options`` of each level (lowest first) act, as ``divergence`` in nats per step.

    That is the mean of KL(π_i ‖ π_j) and KL(π_j ‖ π_i), averaged over steps with weights u_t(i) + u_t(j): over the
    time that one of the two is active; None where neither ever is. Two options of divergence 0 are the same skill
    under two numbers.

    :param pieces: what the networks say of some demonstrations, and the posterior given those; gone through once.
    """
    levels: list[dict[tuple[int, int], Tensor]] = []
    for outputs, posterior in pieces:
        levels = levels or [{} for _ in posterior.u]
        for level, own, u in zip(levels, outputs.callers[:-1], posterior.u, strict=True):
            for pair in combinations(range(u.shape[-1] - 1), 2):
                level[pair] = level.get(pair, 0.0) + _divergence(own, *pair, u)
    return [
        [
            {"options": [i + 1, j + 1], "divergence": float(total / weight) if weight > 0 else None}
            for (i, j), (total, weight) in level.items()
        ]
        for level in levels
    ]


def _divergence(own: CallerOutputs, i: int, j: int, u: Tensor) -> Tensor:
    """Weighted sum over the steps, and the sum of the weights, [2]."""
    steps = torch.zeros(u.shape[:2], dtype=torch.float64)
    control = torch.ones_like(steps)  # mean probability of emitting the control
    if own.selection is not None:
        p, q = (own.selection[:, :, option].double() for option in (i, j))
        both = torch.isfinite(p) & torch.isfinite(q)  # callers of a level emit the same kinds of choices
        steps = torch.where(both, 0.5 * (p.exp() - q.exp()) * (p - q), 0.0).sum(-1)
        control = 0.5 * (p[..., 0].exp() + q[..., 0].exp())
    if own.emission is not None:
        steps = steps + control * own.emission.divergence(i, j)
    weight = u[..., i + 1] + u[..., j + 1]
    return torch.stack([(weight * steps).sum(), weight.sum()])


def paired(ours: np.ndarray, theirs: np.ndarray, lengths: np.ndarray) -> dict[str, float]:
    """Difference in log-likelihood per step between two models on the same demonstrations, with its standard error."""
    difference = ours - theirs
    mean = float(difference.sum() / lengths.sum())
    residual = difference - mean * lengths  # a ratio of sums: the error of its linearisation
    n = len(difference)
    error = float(np.sqrt(residual.var(ddof=1) * n) / lengths.sum()) if n > 1 else float("nan")
    return {"nats_per_step": mean, "standard_error": error}
