"""The outputs of a hierarchy's networks for a batch, and the log-probabilities they stand for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddco_pyro.model.emissions import Emission
from ddco_pyro.model.tables import NEVER, Tables, always_ending, by_step, by_trajectory, normalised

TERMINATION_BOUND = 12.0
"""Termination logits lie within ±12 (ψ between 6e-6 and 1 - 6e-6): no path's probability is exactly 0."""


def bounded(logits: Tensor) -> Tensor:
    """Termination logits within ±``TERMINATION_BOUND``, by a scaled tanh."""
    return TERMINATION_BOUND * torch.tanh(logits / TERMINATION_BOUND)


def _from_zero(logits: Tensor) -> Tensor:
    """Logits [k, N, T] beside zeros, [N, T, k, 2]."""
    return by_trajectory(torch.stack([torch.zeros_like(logits), logits], 1))


@dataclass(frozen=True)
class CallerOutputs:
    """The outputs of the K callers of one level.

    :param options: k, the number of options that they select among; 0 for the lowest level.
    :param logits: of their choices [N, T, K, k], or [N, T, K, 1 + k] with control (choice 0) first; None for
        callers that only emit control.
    :param emission: the distribution of their control, [N, T, K, A]; None for callers that emit none.
    :param numbers: the network's numbers behind the emission, [N, T, K, size].
    """

    options: int
    logits: Tensor | None
    emission: Emission | None
    numbers: Tensor | None = None

    @property
    def shape(self) -> torch.Size:
        """[N, T, K]."""
        if self.emission is not None:
            return self.emission.shape[:-1]
        assert self.logits is not None  # a caller emits something
        return self.logits.shape[:-1]

    @property
    def choices(self) -> Tensor:
        """Logits of η [N, T, K, 1 + k] of callers with options below, -inf where control is impossible."""
        if self.logits is None:
            return pad(torch.zeros(*self.shape, 1), (0, self.options), value=NEVER)
        missing = 1 + self.options - self.logits.shape[-1]
        return by_trajectory(pad(by_step(self.logits), (0, 0, 0, 0, missing, 0), value=NEVER))

    @property
    def selection(self) -> Tensor:
        """log η [N, T, K, 1 + k] of callers with options below them."""
        return normalised(self.choices)

    def map(self, change: Callable[[Tensor], Tensor]) -> CallerOutputs:
        return CallerOutputs(
            self.options,
            None if self.logits is None else change(self.logits),
            None if self.emission is None else self.emission.map(change),
            None if self.numbers is None else change(self.numbers),
        )

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s) of each caller, [N, T, K]; -inf for a caller that emits no control."""
        if self.emission is not None:
            return self.emission.log_density(actions)
        assert self.logits is not None  # a caller emits something
        return self.logits.new_tensor(NEVER).expand(self.shape)


@dataclass(frozen=True)
class Outputs:
    """The outputs of all networks for a batch, before any control is known.

    :param callers: each level's, lowest first, the meta-policy's last.
    :param termination_logits: of each level's options [N, T, k], before they are bounded; None for a level
        whose options end after every step.
    :param power: β of :class:`~ddco_pyro.model.tables.Tables`, a number.
    """

    callers: tuple[CallerOutputs, ...]
    termination_logits: tuple[Tensor | None, ...]
    power: Tensor | float = 1.0

    @property
    def emissions(self) -> tuple[Emission | None, ...]:
        """The distributions of the control of each level's callers, lowest first, the meta-policy's last."""
        return tuple(caller.emission for caller in self.callers)

    @property
    def termination(self) -> tuple[Tensor, ...]:
        """(log(1 - ψ), log ψ) of each level, [N, T, k, 2]."""
        return Tables((), self._endings, logits=True).normalised().termination

    def tables(self, actions: Tensor | None = None) -> Tables:
        """The tables for controls [N, T, A] in scaled units, or selections and terminations alone."""
        return self.logits(actions).normalised()

    def logits(self, actions: Tensor | None = None) -> Tables:
        """The same tables before selections and terminations are normalised, for the fused engine."""
        selection = tuple(caller.choices for caller in self.callers if caller.options)
        control = () if actions is None else tuple(caller.log_density(actions) for caller in self.callers)
        return Tables(selection, self._endings, control, power=float(self.power), logits=True)

    @property
    def _endings(self) -> tuple[Tensor, ...]:
        """Logits of going on and of ending, [N, T, k, 2]."""
        levels = zip(self.callers, self.termination_logits, strict=False)  # the meta-policy has none
        return tuple(
            always_ending(level.shape) if logit is None else _from_zero(bounded(by_step(logit)))
            for level, logit in levels
        )

    def tensors(self) -> list[Tensor]:
        """All outputs of the networks, each [N, T, ...]."""
        logits = [caller.logits for caller in self.callers if caller.logits is not None]
        numbers = [caller.numbers for caller in self.callers if caller.numbers is not None]
        return [*logits, *numbers, *(logit for logit in self.termination_logits if logit is not None)]

    def map(self, change: Callable[[Tensor], Tensor]) -> Outputs:
        logits = (None if logit is None else change(logit) for logit in self.termination_logits)
        return Outputs(tuple(caller.map(change) for caller in self.callers), tuple(logits), self.power)
