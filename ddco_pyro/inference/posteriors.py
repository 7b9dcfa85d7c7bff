"""Posterior marginals of the latents, the E-step of §4.1, and the predictive log-likelihood.

A posterior is a gradient: the derivative of log p(ξ) with respect to the logarithm of a table's entry is the
posterior probability that the entry was used.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import fused
from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.logspace import log_sum
from ddco_pyro.inference.paths import predicted
from ddco_pyro.model.tables import NEVER, Tables, joint_density


class Posterior(NamedTuple):
    """Marginals of §4.1 for every level, lowest first, each float64 [N, T, 1 + k_d] with control as choice 0.

    ``u``: p(h_t = h | ξ). ``v``: p(b_t = 1, h_t = h | ξ). ``w``: p(h_t = h, b_{t+1} = 0 | ξ), 0 at the last
    step. Steps past a trajectory's length are 0.
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
    ...     selection=(torch.tensor([0.0, 0.5, 0.5]).log().expand(1, 1, 1, 3),),  # control, options 1, 2
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
    pairs = zip(u, posteriors.selection, strict=True)  # choice 0 lasts one step: it is always selected
    v = tuple(torch.cat([u_d[..., :1], selected.sum(2)[..., 1:]], dim=-1) for u_d, selected in pairs)
    followed = (torch.arange(1, tables.steps) < lengths[:, None]).unsqueeze(-1)
    w = tuple(torch.zeros_like(u_d) for u_d in u)  # choice 0 always ends
    for w_d, u_d, end in zip(w, u, posteriors.termination, strict=True):
        w_d[:, :-1, 1:] = (u_d[:, :-1, 1:] - end[:, 1:, :, 1]) * followed
    return Posterior(u, v, w)


def log_predictive(tables: Tables, lengths: Tensor) -> Tensor:
    """Σ_t log p(a_t | s_0..t, a_0..t-1) of each trajectory, nats, [N] float64, whatever the power β of the
    tables.

    A power changes the beliefs over options in which past controls count; each control is scored by its
    density. With β = 1 the sum is log p(ξ). The gradient with respect to ``tables.control`` is the belief
    after each control.

    :param lengths: steps of each trajectory, int64 [N].
    """
    density = joint_density(tables.control)
    if tables.depth:
        density = log_sum((predicted(tables, lengths) + density).flatten(2))
    alive = torch.arange(density.shape[1]) < lengths[:, None]
    return torch.where(alive, density, 0.0).sum(1)
