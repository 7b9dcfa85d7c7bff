"""The definition of the likelihood: Pyro eliminates the latents of :func:`ddco_pyro.model.ahmm.ahmm` by enumeration."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pyro.infer import TraceEnum_ELBO
from torch import Tensor

from ddco_pyro.model.ahmm import Scored, ahmm
from ddco_pyro.model.emissions import Steps
from ddco_pyro.model.tables import Tables, complete

BATCH_DIMENSIONS = 1
"""Dimensions of the model's plate; enumeration takes those further left."""


def total_log_likelihood(tables: Tables, lengths: Tensor) -> Tensor:
    """Σ_n log p(ξ_n), a scalar differentiable in the tables."""
    return program_log_likelihood(tables, lengths, *known_controls(tables))


def known_controls(tables: Tables) -> tuple[list[Scored], Tensor]:
    """What :func:`ddco_pyro.model.ahmm.ahmm` takes for emissions and controls where tables hold the densities."""
    return [Scored(table) for table in tables.control], torch.empty(*tables.control[-1].shape[:2], 0)


def program_log_likelihood(
    tables: Tables, lengths: Tensor, emissions: Sequence[Steps | None], actions: Tensor
) -> Tensor:
    """Σ_n log p(ξ_n) where the emissions themselves score the controls [N, T, A], not the tables."""
    elbo = TraceEnum_ELBO(max_plate_nesting=BATCH_DIMENSIONS, strict_enumeration_warning=False)
    chain = complete(tables, lengths)
    if not any(
        leaf is not None and leaf.requires_grad for leaf in tables.leaves()
    ):  # differentiable_loss refuses these
        return torch.tensor(-elbo.loss(ahmm, _no_guide, chain, emissions, actions), dtype=torch.float64)
    return -elbo.differentiable_loss(ahmm, _no_guide, chain, emissions, actions)


def _no_guide(*_: object) -> None:
    """Every latent is enumerated in the model, so the guide has none."""
