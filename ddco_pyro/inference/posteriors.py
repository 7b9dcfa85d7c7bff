"""What the demonstrations say about the latents at each step: posterior marginals, the E-step of §4.1.

They are a gradient: the derivative of log p(ξ) with respect to the logarithm of a table's entry is the posterior
probability that the entry was used.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import fused
from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.model.tables import NEVER, Tables


class Posterior(NamedTuple):
    """Marginals of §4.1 for every level, lowest first, each [N, T, 1 + k_d] with control as choice 0; float64.

    ``u``: p(h_t = h | ξ). ``v``: p(b_t = 1, h_t = h | ξ). ``w``: p(h_t = h, b_{t+1} = 0 | ξ), 0 at the last step.
    Steps past a trajectory's length are 0.
    """

    u: tuple[Tensor, ...]
    v: tuple[Tensor, ...]
    w: tuple[Tensor, ...]


def posterior(tables: Tables, lengths: Tensor) -> Posterior:
    """The E-step: u, v and w of every level (§4.1).

    :raises BadTables: a trajectory has probability 0.
    """
    if not tables.depth:
        return Posterior((), (), ())
    result = fused.eliminate(tables, lengths, marginals=True)
    refuse_impossible(result.value > NEVER)
    u = result.marginals
    v = tuple(
        torch.cat([u_d[..., :1], selected.sum(2)[..., 1:]], dim=-1)  # choice 0 lasts one step: it is always selected
        for u_d, selected in zip(u, result.tables.selection, strict=True)
    )
    w = tuple(_not_ending(u_d, ended[..., 1], lengths) for u_d, ended in zip(u, result.tables.termination, strict=True))
    return Posterior(u, v, w)


def _not_ending(u: Tensor, terminated: Tensor, lengths: Tensor) -> Tensor:
    """w_t = u_t - p(h_t, b_{t+1} = 1 | ξ) where there is a step t + 1; choice 0 always ends."""
    steps = torch.arange(u.shape[1] - 1)
    followed = (steps + 1 < lengths[:, None]).unsqueeze(-1)
    w = torch.zeros_like(u)
    w[:, :-1, 1:] = (u[:, :-1, 1:] - terminated[:, 1:]) * followed
    return w
