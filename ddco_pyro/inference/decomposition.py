"""What each control dimension, and choosing options, add to a log-likelihood.

With q the posterior of the latents, the log-likelihood is exactly what the active options' Gaussians give each
dimension, less what it takes to say which options those are:

    log p(ξ) = Σ_d E_q[Σ_t log N(a_td; μ_d, σ_d²)] − KL(q ‖ p(ζ)),

ζ being the options and terminations, p(ζ) the product of the selections and terminations along them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import fused
from ddco_pyro.model.encoding import Batch, ControlScaling
from ddco_pyro.model.outputs import Decision, Outputs


class Decomposition(NamedTuple):
    """log p(ξ) of N demonstrations in parts, float64 nats in the control's own units.

    :param dimensions: E_q[Σ_t log N(a_td; μ_d, σ_d²)] of the control dimensions in the model, [N, A'].
    :param options: −KL(q ‖ p(ζ)), at most 0; 0 without options, [N].
    """

    dimensions: Tensor
    options: Tensor

    @classmethod
    def joined(cls, parts: Iterable[Decomposition]) -> Decomposition:
        """Those of some demonstrations after those of others."""
        return cls(*(torch.cat(column) for column in zip(*parts, strict=True)))


def decompose(outputs: Outputs, batch: Batch, scaling: ControlScaling) -> Decomposition:
    """The parts of each demonstration's log-likelihood, given what the networks say about the batch."""
    with torch.no_grad():
        exact = Outputs.of(outputs.options, [None if leaf is None else leaf.double() for leaf in outputs.leaves()])
        actions = batch.actions.double()
        value, actors = _posterior(exact, actions, scaling, batch.lengths)
        alive = (batch.inputs.time < batch.lengths[:, None])[..., None, None]
        dimensions = sum(
            (torch.where(alive, weight.unsqueeze(-1) * _densities(decision, actions, scaling), 0.0)).sum((1, 2))
            for decision, weight in zip(exact.decisions, actors, strict=True)
            if decision.mean is not None
        )
        assert isinstance(dimensions, Tensor)  # somebody emits the control
        options = value - dimensions.sum(-1) if len(actors) > 1 else torch.zeros_like(value)
        return Decomposition(dimensions, options)


def _posterior(
    outputs: Outputs, actions: Tensor, scaling: ControlScaling, lengths: Tensor
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """log p(ξ) [N], and the probability that each caller of each level emits the control, [N, T, K]."""
    tables = outputs.tables(actions, scaling.log_volume)
    if not tables.depth:
        return fused.log_likelihood(tables, lengths), (torch.ones_like(tables.control[-1]),)
    found = fused.eliminate(tables, lengths)
    return found.value, found.tables.control


def _densities(decision: Decision, actions: Tensor, scaling: ControlScaling) -> Tensor:
    """log N(a_td; μ_d, σ_d²) of each caller and dimension, [N, T, K, A'], in the control's own units."""
    assert decision.mean is not None  # asked only of who emits a control
    error = (actions.unsqueeze(2) - decision.mean) / decision.std
    return -0.5 * (error.square() + math.log(2 * math.pi)) - decision.std.log() - scaling.scale.log()
