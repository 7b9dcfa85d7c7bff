"""What a fitted hierarchy says about demonstrations: who is active when, for how long, and whether it agrees with
ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.inference import Posterior


@dataclass(frozen=True)
class OptionUse:
    """How one choice of a level (0 is control) is used over all steps of some demonstrations.

    :param share: mean of u_t, the part of the time it is active.
    :param selected: Σ v_t, how often it is selected.
    :param duration: expected steps from a selection to the next, Σ u_t / Σ v_t; None where it is never selected.
    """

    choice: int
    share: float
    selected: float
    duration: float | None


def option_use(posterior: Posterior) -> list[list[OptionUse]]:
    """For each level, lowest first, the use of every choice."""
    found = []
    for u, v in zip(posterior.u, posterior.v, strict=True):
        active, selected = u.sum((0, 1)).numpy(), v.sum((0, 1)).numpy()
        shares = active / active.sum()
        found.append([_use(choice, shares, active, selected) for choice in range(len(active))])
    return found


def _use(choice: int, shares: np.ndarray, active: np.ndarray, selected: np.ndarray) -> OptionUse:
    duration = float(active[choice] / selected[choice]) if selected[choice] > 1e-6 else None
    return OptionUse(choice, float(shares[choice]), float(selected[choice]), duration)


def as_rows(use: Sequence[Sequence[OptionUse]]) -> list[list[dict[str, float | int | None]]]:
    """The same as plain data."""
    return [[asdict(one) for one in level] for level in use]


def agreement(segments: Sequence[np.ndarray], labels: Sequence[np.ndarray]) -> float:
    """Normalised mutual information between segments and labels over all steps of all demonstrations (SM 2.4)."""
    return float(normalized_mutual_info_score(np.concatenate(list(labels)), np.concatenate(list(segments))))


def paired(ours: np.ndarray, theirs: np.ndarray, lengths: np.ndarray) -> dict[str, float]:
    """Difference in log-likelihood per step between two models on the same demonstrations, with its standard error."""
    difference = ours - theirs
    mean = float(difference.sum() / lengths.sum())
    residual = difference - mean * lengths  # a ratio of sums: the error of its linearisation
    n = len(difference)
    error = float(np.sqrt(residual.var(ddof=1) * n) / lengths.sum()) if n > 1 else float("nan")
    return {"nats_per_step": mean, "standard_error": error}
