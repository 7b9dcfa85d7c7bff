"""The definition of the likelihood: Pyro eliminates the latents of :func:`ddco_pyro.model.ahmm.ahmm` by enumeration."""

from __future__ import annotations

from pyro.infer import TraceEnum_ELBO
from torch import Tensor

from ddco_pyro.model.ahmm import Chain, ahmm

BATCH_DIMENSIONS = 1
"""Dimensions of the model's plate; enumeration takes those further left."""


def _no_guide(chain: Chain) -> None:
    """Every latent is enumerated in the model, so the guide has none."""


def total_log_likelihood(chain: Chain) -> Tensor:
    """Σ_n log p(ξ_n), a scalar differentiable in the chain's tables."""
    elbo = TraceEnum_ELBO(max_plate_nesting=BATCH_DIMENSIONS, strict_enumeration_warning=False)
    tables = (*chain.selection, *chain.termination, chain.emission)
    if not any(table.requires_grad for table in tables):  # differentiable_loss refuses these
        return chain.emission.new_tensor(-elbo.loss(ahmm, _no_guide, chain))
    return -elbo.differentiable_loss(ahmm, _no_guide, chain)
