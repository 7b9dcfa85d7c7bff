"""Elimination of the latents in one structured pass in log space, O(D·S) a step for S joint choices.

The transition is a mixture over how far up the terminations reach, so a forward step never builds the S × S matrix.
On the way up each level keeps its choice or passes its mass on. On the way down the selections spread the passed mass,
which joins the kept mass.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.model.tables import NEVER, Chain, Step


def log_sum(values: Tensor) -> Tensor:
    """log Σ exp over the last dimension; where every term is -inf the value is -inf and the gradient 0."""
    possible = (values > NEVER).any(-1)
    finite = torch.where(possible.unsqueeze(-1), values, 0.0)
    return torch.where(possible, finite.logsumexp(-1), NEVER)


def log_likelihood(chain: Chain) -> Tensor:
    """log p(ξ) of each trajectory, [N], differentiable in the chain's tables."""
    if not chain.selection and chain.emission is not None:
        return chain.emission.sum(1)  # nothing is latent
    message: Tensor | None = None
    for now in chain.steps():
        assert now.emission is not None  # nothing else can be scored
        message = arrive(message, now).message + now.emission
    assert message is not None  # there is a step
    return log_sum(message.flatten(1))


class Arrival(NamedTuple):
    """Predicted log-mass at a step, before its control.

    :param message: over the joint choices, [N, C_D, ..., C_1].
    :param kept: the part that terminated below level d and kept its choice there, [N, C_D, ..., C_d] for each level.
    :param selected: the part that selected a choice at level d, of the same shapes.
    """

    message: Tensor
    kept: list[Tensor]
    selected: list[Tensor]


def arrive(message: Tensor | None, now: Step) -> Arrival:
    """The prediction for step t from the log-mass over the joint choices at t - 1, None for t = 0."""
    kept: list[Tensor] = []
    if message is None:
        message = torch.zeros(len(now.alive), dtype=torch.float64, device=now.alive.device)  # everything is selected
    else:
        for table in now.termination:
            keep, terminate = _along_last(table[..., 0], message), _along_last(table[..., 1], message)
            kept.append(message + keep)
            message = log_sum(message + terminate)
    selected: list[Tensor] = []
    for level in range(len(now.selection), 0, -1):
        table = now.selection[level - 1]
        table = table.squeeze(1) if level == len(now.selection) else _along_last_two(table, message)
        selected.insert(0, message.unsqueeze(-1) + table)
        message = log_sum(torch.stack([selected[0], kept[level - 1]], dim=-1)) if kept else selected[0]
    return Arrival(message, kept, selected)


def _along_last(table: Tensor, message: Tensor) -> Tensor:
    """[N, C_d] against [N, C_D, ..., C_d]."""
    return table.reshape(table.shape[:1] + (1,) * (message.dim() - 2) + table.shape[1:])


def _along_last_two(table: Tensor, message: Tensor) -> Tensor:
    """[N, C_{d+1}, C_d] against [N, C_D, ..., C_{d+1}, 1]."""
    return table.reshape(table.shape[:1] + (1,) * (message.dim() - 2) + table.shape[1:])


def marginal(joint: Tensor, level: int) -> Tensor:
    """[N, T, C_D, ..., C_1] summed to the choices of level d, [N, T, C_d]."""
    others = [dim for dim in range(2, joint.dim()) if dim != joint.dim() - level]
    return joint.sum(others) if others else joint
