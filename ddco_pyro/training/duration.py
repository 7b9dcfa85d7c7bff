"""A prior on how long options last (``training.duration``)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ddco_pyro.model.tables import always_ends
from ddco_pyro.spec import DurationSpec


def log_duration_prior(termination: Sequence[Tensor], lengths: Tensor, prior: DurationSpec) -> Tensor:
    """Σ_d Σ_h Σ_n Σ_t w (log ψ_h(s_t) + (m_d - 1) log(1 - ψ_h(s_t))), nats, a scalar in float64.

    ψ is that of option h of level d, w the prior's weight, m_d its mean. Divided by the number of steps this is the
    mean over states of the log-density of Beta distributions of ψ with mean 1/m_d and w terminations, each as a
    density of the logit of ψ and up to a constant. A level whose options end after every step has no such
    distribution, and adds nothing.

    :param termination: (log(1 - ψ), log ψ) of each level, lowest first, [N, T, k, 2].
    :param lengths: steps of each trajectory, [N].
    """
    means = prior.mean if isinstance(prior.mean, tuple) else (prior.mean,) * len(termination)
    total = torch.zeros((), dtype=torch.float64)
    for table, mean in zip(termination, means, strict=False):  # lower levels alone, where those are discovered
        if always_ends(table):
            continue
        alive = torch.arange(table.shape[1], device=lengths.device) < lengths[:, None]
        counts = prior.weight * torch.tensor([mean - 1.0, 1.0], dtype=torch.float64)
        total = total + (table.double() * counts)[alive].sum()
    return total
