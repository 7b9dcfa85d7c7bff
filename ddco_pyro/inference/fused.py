"""The fused engine: log-likelihood and posterior in one compiled pass; the posterior *is* the gradient (§4.1).

It works in scaled probability space. What underflows there is lost mass of at most about 1e-300 of a step's total, and
it matters only if the past and the future of a trajectory hardly overlap, Σ_h α_t(h) β_t(h) ≈ 0. The overlap is
measured at every step, and a trajectory where it falls below ``LEAST_OVERLAP`` is done again in log space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ddco_pyro.ahmm import Chain
from ddco_pyro.inference import logspace
from ddco_pyro.inference.kernel import forward_backward

LEAST_OVERLAP = 1e-250


def log_likelihood(chain: Chain, lengths: Tensor) -> Tensor:
    """log p(ξ) of each trajectory, [N], differentiable once in the chain's tables."""
    if chain.emission.device.type != "cpu":
        return logspace.log_likelihood(chain)
    value: Tensor = _Eliminate.apply(lengths, chain.emission, *chain.selection, *chain.termination)
    return value


class _Eliminate(torch.autograd.Function):
    """Log-likelihoods of a chain; the gradient with respect to a log-table is the posterior of its entries."""

    @staticmethod
    def forward(ctx: Any, lengths: Tensor, emission: Tensor, *tables: Tensor) -> Tensor:
        depth = len(tables) // 2
        chain = Chain(tables[:depth], tables[depth:], emission)
        value, gradients = evaluate(chain, lengths)
        ctx.save_for_backward(*gradients)
        return value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        return None, *(upstream.reshape(-1, *(1,) * (table.dim() - 1)) * table for table in ctx.saved_tensors)


def evaluate(chain: Chain, lengths: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Log-likelihoods [N], and posteriors shaped like (emission, *selection, *termination)."""
    flat = chain.emission.reshape(*chain.emission.shape[:2], -1)
    shift = flat.amax(-1, keepdim=True)
    shift = torch.where(torch.isfinite(shift), shift, 0.0)
    sizes = [table.shape[-1] for table in chain.selection]
    joint = (flat - shift).exp()
    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    torch.set_num_threads(threads)  # numba's first call has set OpenMP's number for the whole process, torch included
    value, overlap, to_select, to_end, to_emission = forward_backward(
        _rows(chain.selection, joint).numpy(),
        _rows(chain.termination, joint).numpy(),
        joint.contiguous().numpy(),
        lengths.numpy(),
        np.array(sizes, dtype=np.int64),
        _message_starts(sizes),
        _offsets([2 * size for size in sizes]),
        _offsets([table.shape[2] * table.shape[3] for table in chain.selection]),
    )
    alive = torch.arange(joint.shape[1]) < lengths[:, None]
    total = torch.from_numpy(value) + (shift.squeeze(-1) * alive).sum(1)
    gradients = (
        torch.from_numpy(to_emission).reshape(chain.emission.shape),
        *_unrows(torch.from_numpy(to_select), chain.selection),
        *_unrows(torch.from_numpy(to_end), chain.termination),
    )
    for n in np.flatnonzero(~(overlap > LEAST_OVERLAP)):
        total[n] = _again(chain, int(n), gradients)
    return total, gradients


def _rows(tables: Sequence[Tensor], like: Tensor) -> Tensor:
    """exp of each level's table, flattened and side by side, [N, T, ...]."""
    flat = [table.flatten(2).exp() for table in tables]
    return torch.cat([like[..., :0], *flat], dim=-1).contiguous()


def _unrows(rows: Tensor, tables: Sequence[Tensor]) -> list[Tensor]:
    parts = rows.split([table[0, 0].numel() for table in tables], dim=-1) if tables else ()
    return [part.reshape(table.shape) for part, table in zip(parts, tables, strict=True)]


def _offsets(sizes: Sequence[int]) -> np.ndarray:
    return np.cumsum([0, *sizes])[:-1].astype(np.int64)


def _message_starts(sizes: Sequence[int]) -> np.ndarray:
    """First index of each level's message, lowest level first and that of level D + 1 last."""
    lengths = [int(np.prod(sizes[level:])) for level in range(len(sizes))]
    return np.cumsum([0, *lengths]).astype(np.int64)


def _again(chain: Chain, n: int, gradients: tuple[Tensor, ...]) -> Tensor:
    """The log-likelihood of trajectory ``n`` in log space; its posterior is written into ``gradients``."""
    leaves = [t[n : n + 1].detach().requires_grad_() for t in (chain.emission, *chain.selection, *chain.termination)]
    depth = chain.depth
    alone = replace(
        chain, emission=leaves[0], selection=tuple(leaves[1 : 1 + depth]), termination=tuple(leaves[1 + depth :])
    )
    with torch.enable_grad():
        value = logspace.log_likelihood(alone)
        found = torch.autograd.grad(value.sum(), leaves, allow_unused=True)
    for table, gradient in zip(gradients, found, strict=True):
        table[n] = 0.0 if gradient is None else gradient[0]
    return value.detach()[0]
