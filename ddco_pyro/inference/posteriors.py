"""Posterior marginals of the latents, the E-step of §4.1, and the log-likelihood that they decompose.

A posterior is a gradient: the derivative of log p(ξ) with respect to the logarithm of a table's entry is the posterior
probability that the entry was used.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import fused
from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.logspace import log_sum
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import NEVER, Tables, joint_density


class Posterior(NamedTuple):
    """Marginals of §4.1 for every level, lowest first, each float64 [N, T, 1 + k_d] with control as choice 0.

    ``u``: p(h_t = h | ξ). ``v``: p(b_t = 1, h_t = h | ξ). ``w``: p(h_t = h, b_{t+1} = 0 | ξ), 0 at the last step.
    Steps past a trajectory's length are 0.
    """

    u: tuple[Tensor, ...]
    v: tuple[Tensor, ...]
    w: tuple[Tensor, ...]


def posterior(tables: Tables, lengths: Tensor) -> Posterior:
    """u, v and w of every level: the E-step of §4.1.

    :param lengths: steps of each trajectory, int64 [N].
    :raises BadTables: a trajectory has probability 0.

    >>> import torch
    >>> from ddco_pyro.inference import posterior
    >>> from ddco_pyro.model.tables import Tables
    >>> tables = Tables(
    ...     selection=(torch.tensor([0.0, 0.5, 0.5]).log().expand(1, 1, 1, 3),),  # control, option 1, option 2
    ...     termination=(torch.tensor([0.0, 1.0]).log().expand(1, 1, 2, 2),),  # 1 - ψ and ψ of both options
    ...     control=(torch.tensor([1.0, 3.0]).log().expand(1, 1, 2), torch.full((1, 1, 1), -torch.inf)),
    ... )
    >>> posterior(tables, torch.tensor([1])).u
    (tensor([[[0.0000, 0.2500, 0.7500]]], dtype=torch.float64),)
    """
    if not tables.depth:
        return Posterior((), (), ())
    found = fused.posteriors(tables, lengths, marginals=True)
    refuse_impossible(found.value > NEVER)
    posteriors, u = found.tables, found.marginals
    v = tuple(
        torch.cat([u_d[..., :1], selected.sum(2)[..., 1:]], dim=-1)  # choice 0 lasts one step: it is always selected
        for u_d, selected in zip(u, posteriors.selection, strict=True)
    )
    w = tuple(_not_ending(u_d, end[..., 1], lengths) for u_d, end in zip(u, posteriors.termination, strict=True))
    return Posterior(u, v, w)


def _not_ending(u: Tensor, terminated: Tensor, lengths: Tensor) -> Tensor:
    """w_t = u_t - p(h_t, b_{t+1} = 1 | ξ) where there is a step t + 1; choice 0 always ends."""
    steps = torch.arange(u.shape[1] - 1)
    followed = (steps + 1 < lengths[:, None]).unsqueeze(-1)
    w = torch.zeros_like(u)
    w[:, :-1, 1:] = (u[:, :-1, 1:] - terminated[:, 1:]) * followed
    return w


def log_predictive(tables: Tables, lengths: Tensor) -> Tensor:
    """Σ_t log p(a_t | s_0..t, a_0..t-1) of each trajectory, nats, [N] float64, whatever the power β of the tables.

    A power changes the beliefs over options in which past controls count; each control is scored by its density. With
    β = 1 the sum is log p(ξ). The gradient with respect to ``tables.control`` is the belief after each control.

    :param lengths: steps of each trajectory, int64 [N].

    >>> import torch
    >>> selection, ending = torch.tensor([0.0, 0.5, 0.5]).log(), torch.tensor([1.0, 0.0]).log()
    >>> tables = Tables(  # an option that is kept for ever, of two
    ...     selection=(selection.expand(1, 2, 1, 3),),
    ...     termination=(ending.expand(1, 2, 2, 2),),
    ...     control=(torch.tensor([4.0, 1.0]).log().expand(1, 2, 2), torch.full((1, 2, 1), -torch.inf)),
    ...     power=0.5,
    ... )
    >>> log_predictive(tables, torch.tensor([2])).exp()  # (0.5 · 4 + 0.5 · 1) (2/3 · 4 + 1/3 · 1), by √4 : √1
    tensor([7.5000], dtype=torch.float64)
    """
    density = joint_density(tables.control)
    if tables.depth:
        density = log_sum((fused.predicted(tables, lengths) + density).flatten(2))
    alive = torch.arange(density.shape[1]) < lengths[:, None]
    return torch.where(alive, density, 0.0).sum(1)


class Decomposition(NamedTuple):
    """log p(ξ) of N demonstrations in parts, float64 nats in the control's own units.

    p_t is the belief over options before the control of step t, q_t the belief after it:

        log p(ξ) = Σ_t log Σ_h p_t(h) π_h(a_t) = Σ_d Σ_t E_q_t[log π(a_td)] − Σ_t KL(q_t ‖ p_t).

    :param dimensions: Σ_t E_q_t[log π(a_td)] of the control dimensions in the model, [N, A'].
    :param options: −Σ_t KL(q_t ‖ p_t), at most 0; 0 without options, [N].
    """

    dimensions: Tensor
    options: Tensor

    @classmethod
    def joined(cls, parts: Iterable[Decomposition]) -> Decomposition:
        """The decompositions of several groups of demonstrations, in their order."""
        return cls(*(torch.cat(column) for column in zip(*parts, strict=True)))


def decompose(outputs: Outputs, batch: Batch) -> Decomposition:
    """The parts of each demonstration's log-likelihood, given the networks' outputs for the batch."""
    exact, actions = outputs.map(lambda tensor: tensor.detach().double()), batch.actions.double()
    tables = exact.tables(actions)
    control = tuple(table.detach().requires_grad_() for table in tables.control)
    value = log_predictive(replace(tables, control=control), batch.lengths)
    actors = torch.autograd.grad(value.sum(), control)
    with torch.no_grad():
        value = value.detach()
        alive = (batch.inputs.time < batch.lengths[:, None])[..., None, None]
        dimensions = sum(
            torch.where(alive, weight.unsqueeze(-1) * emission.by_dimension(actions), 0.0).sum((1, 2))
            for emission, weight in zip(exact.emissions, actors, strict=True)
            if emission is not None
        )
        assert isinstance(dimensions, Tensor)  # the lowest level emits the control
        options = value - dimensions.sum(-1) if tables.depth else torch.zeros_like(value)
        return Decomposition(dimensions, options)
