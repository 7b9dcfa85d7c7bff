"""What the demonstrations say about the latents: posterior marginals (the E-step of §4.1) and the most likely path.

Both are gradients. The derivative of log p(ξ) with respect to the logarithm of a table's entry is the posterior
probability that the entry was used; the derivative of the best path's log-probability is 1 where the path goes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.ahmm import Tables, complete
from ddco_pyro.inference import fused, logspace


class Posterior(NamedTuple):
    """Marginals of §4.1 for every level, lowest first, each [N, T, 1 + k_d] with control as choice 0; float64.

    ``u``: p(h_t = h | ξ). ``v``: p(b_t = 1, h_t = h | ξ). ``w``: p(h_t = h, b_{t+1} = 0 | ξ), 0 at the last step.
    Steps past a trajectory's length are 0.
    """

    u: tuple[Tensor, ...]
    v: tuple[Tensor, ...]
    w: tuple[Tensor, ...]


def posterior(tables: Tables, lengths: Tensor) -> Posterior:
    """The E-step: u, v and w of every level (§4.1)."""
    chain = complete(tables, lengths)
    _, (joint, *others) = fused.evaluate(chain, lengths)
    selected, terminated = others[: chain.depth], others[chain.depth :]
    u = tuple(_marginal(joint, level) for level in range(1, chain.depth + 1))
    v = tuple(gradient.sum(2) for gradient in selected)
    w = tuple(_not_ending(u_d, gradient[..., 1], lengths) for u_d, gradient in zip(u, terminated, strict=True))
    return Posterior(u, v, w)


def segment(tables: Tables, lengths: Tensor) -> tuple[Tensor, ...]:
    """The choices of the most likely path max_ζ p(ζ | ξ), a [N, T] per level, lowest first; -1 past the length."""
    chain = complete(tables, lengths)
    emission = chain.emission.detach().requires_grad_()
    with torch.enable_grad():
        best = logspace.log_likelihood(replace(chain, emission=emission), plus=logspace.maximum)
        (path,) = torch.autograd.grad(best.sum(), emission)
    alive = torch.arange(path.shape[1]) < lengths[:, None]
    return tuple(torch.where(alive, _marginal(path, level).argmax(-1), -1) for level in range(1, chain.depth + 1))


def _marginal(joint: Tensor, level: int) -> Tensor:
    """[N, T, C_D, ..., C_1] to the marginal of level d, [N, T, C_d]."""
    others = [dim for dim in range(2, joint.dim()) if dim != joint.dim() - level]
    return joint.sum(others) if others else joint


def _not_ending(u: Tensor, terminated: Tensor, lengths: Tensor) -> Tensor:
    """w_t = u_t - p(h_t, b_{t+1} = 1 | ξ) where there is a step t + 1."""
    steps = torch.arange(u.shape[1] - 1)
    followed = (steps + 1 < lengths[:, None]).unsqueeze(-1)
    w = torch.zeros_like(u)
    w[:, :-1] = (u[:, :-1] - terminated[:, 1:]) * followed
    return w
