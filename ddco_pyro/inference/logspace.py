"""Elimination of the latents in one structured pass in log space, O(D·S) a step for S joint choices.

The transition of DESIGN §4 is a mixture over how far up the terminations reach, so a forward step never builds the
S × S matrix: going up, each level either keeps its choice or passes its mass on; going down, the mass that was
passed on is spread by the selections and joins what was kept.

The same pass with the maximum in place of the sum gives the most likely path.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ddco_pyro.ahmm import NEVER, Chain, Step

Plus = Callable[[Tensor], Tensor]
"""Addition of the semiring along the last dimension."""


def log_sum(values: Tensor) -> Tensor:
    """log Σ exp over the last dimension; where nothing is possible the value is -inf and the gradient 0."""
    possible = (values > NEVER).any(-1)
    finite = torch.where(possible.unsqueeze(-1), values, 0.0)
    return torch.where(possible, finite.logsumexp(-1), NEVER)


def maximum(values: Tensor) -> Tensor:
    """The largest value of the last dimension; a tie's gradient goes to one of its entries alone."""
    return values.max(-1).values


def log_likelihood(chain: Chain, plus: Plus = log_sum) -> Tensor:
    """log p(ξ) of each trajectory, [N], differentiable in the chain's tables.

    With ``plus=maximum``: max over ζ of log p(ζ, ξ).
    """
    first, *later = chain.steps()
    message = _select(first.emission.new_zeros(len(first.emission)), first, [], plus) + first.emission
    for now in later:
        message = _transition(message, now, plus) + now.emission
    return plus(message.flatten(1)) if chain.selection else message


def _transition(message: Tensor, now: Step, plus: Plus) -> Tensor:
    """Mass over the joint choices at t - 1 to mass over those at t, both [N, C_D, ..., C_1]."""
    kept: list[Tensor] = []
    for table in now.termination:
        keep, terminate = _along_last(table[..., 0], message), _along_last(table[..., 1], message)
        kept.append(message + keep)
        message = plus(message + terminate)
    return _select(message, now, kept, plus)


def _select(message: Tensor, now: Step, kept: list[Tensor], plus: Plus) -> Tensor:
    """Spread what terminated, [N], over the choices of every level from the highest down; add what was kept."""
    for level in range(len(now.selection), 0, -1):
        table = now.selection[level - 1]
        table = table.squeeze(1) if level == len(now.selection) else _along_last_two(table, message)
        message = message.unsqueeze(-1) + table
        if kept:
            message = plus(torch.stack([message, kept[level - 1]], dim=-1))
    return message


def _along_last(table: Tensor, message: Tensor) -> Tensor:
    """[N, C_d] against [N, C_D, ..., C_d]."""
    return table.reshape(table.shape[:1] + (1,) * (message.dim() - 2) + table.shape[1:])


def _along_last_two(table: Tensor, message: Tensor) -> Tensor:
    """[N, C_{d+1}, C_d] against [N, C_D, ..., C_{d+1}, 1]."""
    return table.reshape(table.shape[:1] + (1,) * (message.dim() - 2) + table.shape[1:])
