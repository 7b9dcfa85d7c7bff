"""Elimination of the latents in log space, step by step, O(D·S) a step for S joint choices; and the online
filter.

The transition is a mixture over how far up the terminations reach, so a forward step never builds the S × S
matrix. On the way up each level keeps its choice or passes its mass on. On the way down the selections spread
the passed mass, which joins the kept mass.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddco_pyro.model.tables import NEVER, Chain


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
        message = arrive(message, now) + now.emission
    assert message is not None  # there is a step
    return log_sum(message.flatten(1))


def arrive(message: Tensor | None, now: Chain) -> Tensor:
    """The predicted log-mass of the joint choices at step t, before its control, [N, C_D, ..., C_1].

    :param message: that at t - 1, with its control; None for t = 0.
    """
    kept: list[Tensor] = []
    if message is None:
        # everything is selected
        message = torch.zeros(len(now.alive), dtype=torch.float64, device=now.alive.device)
    else:
        for table in now.termination:
            keep, terminate = _along(table[..., 0], message), _along(table[..., 1], message)
            kept.append(message + keep)
            message = log_sum(message + terminate)
    for level in range(len(now.selection), 0, -1):
        table = now.selection[level - 1]
        table = table.squeeze(1) if level == len(now.selection) else _along(table, message)
        selected = message.unsqueeze(-1) + table
        message = log_sum(torch.stack([selected, kept[level - 1]], dim=-1)) if kept else selected
    return message


def _along(table: Tensor, message: Tensor) -> Tensor:
    """[N, C_d] against [N, C_D, ..., C_d], or [N, C_{d+1}, C_d] against [N, C_D, ..., C_{d+1}, 1]."""
    return table.reshape(table.shape[:1] + (1,) * (message.dim() - 2) + table.shape[1:])


def marginal(joint: Tensor, level: int) -> Tensor:
    """[N, T, C_D, ..., C_1] summed to the choices of level d, [N, T, C_d]."""
    others = [dim for dim in range(2, joint.dim()) if dim != joint.dim() - level]
    return joint.sum(others) if others else joint


class Filter:
    """An exact online filter: call :meth:`predict` with each step's tables, then :meth:`update` with its
    control.

    Evidence in a step's tables conditions the belief at this step and later ones; it has to be of the past
    alone.

    :param power: β, how many times the log-density of a control counts in later beliefs.
    :ivar log_likelihood: log p(a_0..t-1 | s) so far, [N] nats.
    """

    def __init__(self, power: float = 1.0) -> None:
        self.power = power
        self.log_likelihood = torch.zeros(1, dtype=torch.float64)
        self._message: Tensor | None = None

    def predict(self, now: Chain) -> tuple[Tensor, ...]:
        """p(h^d_t | s_0..t, a_0..t-1) of every level, lowest first, each float64 [N, C_d]."""
        message = arrive(self._message, now)
        self._message = message if now.evidence is None else _normalised(message + now.evidence)
        joint = self._message.exp().unsqueeze(1)
        return tuple(marginal(joint, level).squeeze(1) for level in range(1, 1 + len(now.selection)))

    def update(self, density: Tensor) -> None:
        """Condition on the applied control, given its log-density for each joint choice, [N, C_D, ..., C_1].

        :raises ValueError: the control has probability 0.
        """
        assert self._message is not None  # predict() has been called
        total = _log_mass(self._message + density)
        if not bool(torch.isfinite(total).all()):
            raise ValueError(
                "the control has probability 0 under every choice; is it in the demonstrations' units?"
            )
        self.log_likelihood = self.log_likelihood + total
        self._message = _normalised(self._message + self.power * density)


def _log_mass(message: Tensor) -> Tensor:
    """The logarithm of the mass of all joint choices, [N]."""
    return log_sum(message.flatten(1)) if message.dim() > 1 else message


def _normalised(message: Tensor) -> Tensor:
    return message - _log_mass(message).reshape(-1, *(1,) * (message.dim() - 1))
