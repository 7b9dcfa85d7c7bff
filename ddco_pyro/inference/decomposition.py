"""What each control dimension, and choosing options, add to a log-likelihood.

With q the posterior of the latents, the log-likelihood is exactly what the active options give each
dimension, less what it takes to say which options those are:

    log p(ξ) = Σ_d E_q[Σ_t log π(a_td)] − KL(q ‖ p(ζ)),

ζ being the options and terminations, p(ζ) the product of the selections and terminations along them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import fused
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.outputs import Outputs


class Decomposition(NamedTuple):
    """log p(ξ) of N demonstrations in parts, float64 nats in the control's own units.

    :param dimensions: E_q[Σ_t log π(a_td)] of the control dimensions in the model, [N, A'].
    :param options: −KL(q ‖ p(ζ)), at most 0; 0 without options, [N].
    """

    dimensions: Tensor
    options: Tensor

    @classmethod
    def joined(cls, parts: Iterable[Decomposition]) -> Decomposition:
        """Those of some demonstrations after those of others."""
        return cls(*(torch.cat(column) for column in zip(*parts, strict=True)))


def decompose(outputs: Outputs, batch: Batch) -> Decomposition:
    """The parts of each demonstration's log-likelihood, given what the networks say about the batch."""
    with torch.no_grad():
        exact, actions = outputs.map(Tensor.double), batch.actions.double()
        value, actors = _posterior(exact, actions, batch.lengths)
        alive = (batch.inputs.time < batch.lengths[:, None])[..., None, None]
        dimensions = sum(
            torch.where(alive, weight.unsqueeze(-1) * emission.by_dimension(actions), 0.0).sum((1, 2))
            for emission, weight in zip(exact.emissions, actors, strict=True)
            if emission is not None
        )
        assert isinstance(dimensions, Tensor)  # somebody emits the control
        options = value - dimensions.sum(-1) if len(actors) > 1 else torch.zeros_like(value)
        return Decomposition(dimensions, options)


def _posterior(outputs: Outputs, actions: Tensor, lengths: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """log p(ξ) [N], and the probability that each caller of each level emits the control, [N, T, K]."""
    tables = outputs.tables(actions)
    if not tables.depth:
        return fused.log_likelihood(tables, lengths), (torch.ones_like(tables.control[-1]),)
    elimination = fused.eliminate(tables, lengths)
    return elimination.value, elimination.tables.control
