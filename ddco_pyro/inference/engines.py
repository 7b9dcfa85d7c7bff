"""The likelihood by either engine, without the checks of :mod:`ddco_pyro.inference.arguments`."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from ddco_pyro.inference import enumeration, fused
from ddco_pyro.model.tables import Tables

Engine = Literal["fused", "enumerate"]


def log_likelihood(tables: Tables, lengths: Tensor, engine: Engine = "fused") -> Tensor:
    """log p(ξ) in nats of each trajectory, [N] float64, differentiable in the tables; -inf where ξ is impossible.

    :param lengths: steps of each trajectory, [N]; whatever the tables hold beyond is ignored.
    """
    if engine == "fused":
        return fused.log_likelihood(tables, lengths)
    one_by_one = [
        enumeration.total_log_likelihood(tables.trajectory(n, int(length)), lengths[n : n + 1])
        for n, length in enumerate(lengths)
    ]
    return torch.stack(one_by_one)


def total_log_likelihood(tables: Tables, lengths: Tensor, engine: Engine = "fused") -> Tensor:
    """Σ_n log p(ξ_n), a scalar; with ``engine="enumerate"`` in one elimination for the whole batch."""
    if engine == "enumerate":
        return enumeration.total_log_likelihood(tables, lengths)
    return fused.log_likelihood(tables, lengths).sum()
