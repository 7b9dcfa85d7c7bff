"""The online filter: beliefs over options while a trajectory is still running; O(D·S) a step."""

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
    """An exact filter: call :meth:`predict` with each step's tables, then :meth:`update` with its control.

    Evidence in a step's tables conditions the belief at this step and later ones; it has to be of the past alone.

    :param power: β, how many times the log-density of a control counts in later beliefs.
    """

    def __init__(self, power: float = 1.0) -> None:
        self.power = power
        self._before: Tensor | None = None
        self._now: Tensor | None = None
        self.log_likelihood = torch.zeros(1, dtype=torch.float64)
        """log p(a_0..t-1 | s) so far, [N] nats."""

    def predict(self, now: Step) -> Belief:
        """The belief at step t, before its control.

        :raises BadTables: the step has another number of demonstrations or of options than earlier steps.
        """
        if self._before is not None and self._before.shape != (expected := _joint(now)):
            raise BadTables(f"step: expected joint choices {list(self._before.shape)}; got {list(expected)}")
        arrival = arrive(self._before, now)
        if now.evidence is not None:
            arrival = _given(arrival, now, now.evidence)
        self._now = arrival.message
        return Belief(tuple(_marginals(arrival, level) for level in range(len(now.selection))))

    def update(self, density: Tensor) -> None:
        """Condition on the applied control, given its log-density for each joint choice, [N, C_D, ..., C_1].

        :raises ValueError: :meth:`predict` was not called, the control has probability 0, or the shape is wrong.
        """
        if self._now is None:
            raise ValueError("update() follows predict(): there is no step to which this control belongs")
        if density.shape != self._now.shape:
            raise BadTables(f"density: expected {list(self._now.shape)}; got {list(density.shape)}")
        total = _log_mass(self._now + density)
        if not bool(torch.isfinite(total).all()):
            raise ValueError("the control has probability 0 under every choice; is it in the demonstrations' units?")
        self.log_likelihood = self.log_likelihood + total
        message = self._now + self.power * density
        self._before, self._now = message - _log_mass(message).reshape(-1, *(1,) * (message.dim() - 1)), None


def _given(arrival: Arrival, now: Step, evidence: Tensor) -> Arrival:
    """The arrival given evidence of the joint choice, [N, C_D, ..., C_1].

    What is kept or selected at level d leaves all lower levels to be selected: the evidence there is summed over them.
    """
    message = arrival.message + evidence
    mass, kept, selected = _log_mass(message), list[Tensor](), list[Tensor]()
    for level, table in enumerate(now.selection):
        own = evidence - mass.reshape(-1, *(1,) * (evidence.dim() - 1))
        kept += [arrival.kept[level] + own] if arrival.kept else []
        selected.append(arrival.selected[level] + own)
        above = table.reshape(table.shape[:1] + (1,) * (evidence.dim() - 3) + table.shape[1:])
        evidence = log_sum(evidence + (above if evidence.dim() > 2 else table.squeeze(1)))
    return Arrival(message - mass.reshape(-1, *(1,) * (message.dim() - 1)), kept, selected)


def _log_mass(message: Tensor) -> Tensor:
    """Its logarithm over all joint choices, [N]."""
    return log_sum(message.flatten(1)) if message.dim() > 1 else message


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
    """The marginal of the level ``above`` levels higher than a message's lowest level, [N, C]."""
    own = message.dim() - 1 - above
    others = [dim for dim in range(1, message.dim()) if dim != own]
    return message.exp().sum(others) if others else message.exp()
