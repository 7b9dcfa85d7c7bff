"""The online filter: what is known of the options while a demonstration, or a robot, still runs; O(D·S) a step."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference.arguments import BadTables
from ddco_pyro.inference.logspace import Arrival, arrive, log_sum
from ddco_pyro.model.tables import Step


class Belief(NamedTuple):
    """p(h^d_t, b^d_t | s_0..t, a_0..t-1) of every level, lowest first, each float64 [N, C_d, 2], b last."""

    levels: tuple[Tensor, ...]

    @property
    def choices(self) -> tuple[Tensor, ...]:
        """p(h^d_t | s_0..t, a_0..t-1), each [N, C_d]."""
        return tuple(level.sum(-1) for level in self.levels)


class Filter:
    """Alternate :meth:`predict`, once a step's observation is known, and :meth:`update`, once its control is."""

    def __init__(self) -> None:
        self._before: Tensor | None = None
        self._now: Tensor | None = None
        self.log_likelihood = torch.zeros(1, dtype=torch.float64)
        """log p(a_0..t-1 | s) so far, [N] nats."""

    def predict(self, now: Step) -> Belief:
        """The belief at step t; the control is not known yet.

        :raises BadTables: the step is of another number of demonstrations, or of other options, than those before.
        """
        if self._before is not None and self._before.shape != (expected := _joint(now)):
            raise BadTables(f"step: expected joint choices {list(self._before.shape)}; got {list(expected)}")
        arrival = arrive(self._before, now)
        self._now = arrival.message
        return Belief(tuple(_marginals(arrival, level) for level in range(len(now.selection))))

    def update(self, emission: Tensor) -> None:
        """Take in the control that was applied: its log-density given each joint choice, [N, C_D, ..., C_1].

        :raises ValueError: no step has been predicted, the control is impossible whatever the choice, or the shape is
            another.
        """
        if self._now is None:
            raise ValueError("update() follows predict(): there is no step to which this control belongs")
        if emission.shape != self._now.shape:
            raise BadTables(f"emission: expected {list(self._now.shape)}; got {list(emission.shape)}")
        message = self._now + emission
        total = log_sum(message.flatten(1)) if message.dim() > 1 else message
        if not bool(torch.isfinite(total).all()):
            raise ValueError("the control has probability 0 under every choice; is it in the demonstrations' units?")
        self.log_likelihood = self.log_likelihood + total
        self._before, self._now = message - total.reshape(-1, *(1,) * (message.dim() - 1)), None


def _joint(now: Step) -> tuple[int, ...]:
    """The shape of a message over the joint choices of a step, [N, C_D, ..., C_1]."""
    return (len(now.alive), *(table.shape[-1] for table in reversed(now.selection)))


def _marginals(arrival: Arrival, index: int) -> Tensor:
    """p(h^d, b^d), [N, C_d, 2]: kept at level d or below it, or selected at level d."""
    selected = _onto(arrival.selected[index], 0)
    kept = torch.zeros_like(selected)
    for lower, message in enumerate(arrival.kept[: index + 1]):
        kept = kept + _onto(message, index - lower)
    return torch.stack([kept, selected], dim=-1)


def _onto(message: Tensor, above: int) -> Tensor:
    """The probabilities of the choices that are ``above`` places above a message's lowest level, [N, C]."""
    own = message.dim() - 1 - above
    others = [dim for dim in range(1, message.dim()) if dim != own]
    return message.exp().sum(others) if others else message.exp()
