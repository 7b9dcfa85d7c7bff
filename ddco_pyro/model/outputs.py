"""The outputs of a hierarchy's networks for a batch, and the log-probabilities they stand for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddco_pyro.model.emissions import Density, Emission
from ddco_pyro.model.links import Link, LinkedTables, LogTable, Selection, Termination
from ddco_pyro.model.tables import NEVER, always_ending


@dataclass(frozen=True)
class CallerOutputs:
    """The outputs of the K callers of one level.

    :param options: k, the number of options that they select among; 0 for the lowest level.
    :param logits: of their choices [N, T, K, k], or [N, T, K, 1 + k] with control (choice 0) first; None for callers
        that only emit control.
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
    def selection(self) -> Tensor | None:
        """log η [N, T, K, 1 + k]; None without options."""
        link = self.selection_link
        return None if link is None else link.table

    @property
    def selection_link(self) -> Link | None:
        """log η, not computed."""
        if not self.options:
            return None
        if self.logits is not None:
            return Selection(self.logits, 1 + self.options - self.logits.shape[-1])
        return LogTable(pad(torch.zeros(*self.shape, 1), (0, self.options), value=NEVER))

    def map(self, change: Callable[[Tensor], Tensor]) -> CallerOutputs:
        """The outputs of changed tensors."""
        return CallerOutputs(
            self.options,
            None if self.logits is None else change(self.logits),
            None if self.emission is None else self.emission.map(change),
            None if self.numbers is None else change(self.numbers),
        )

    def density_link(self, actions: Tensor) -> Link:
        """log π(a | s) of each caller, [N, T, K], not computed; -inf for a caller that emits no control."""
        if self.emission is None:
            assert self.logits is not None  # a caller emits something
            return LogTable(self.logits.new_tensor(NEVER).expand(self.logits.shape[:-1]), log=True)
        if actions.requires_grad:
            return LogTable(self.emission.log_density(actions), log=True)
        return Density(self.emission, actions)


@dataclass(frozen=True)
class Outputs:
    """The outputs of all networks for a batch, before any control is known.

    :param callers: each level's, lowest first, the meta-policy's last.
    :param termination_logits: of each level's options [N, T, k], before they are bounded; None for a level whose
        options end after every step.
    """

    callers: tuple[CallerOutputs, ...]
    termination_logits: tuple[Tensor | None, ...]

    @property
    def emissions(self) -> tuple[Emission | None, ...]:
        """The distributions of the control of each level's callers, lowest first, the meta-policy's last."""
        return tuple(caller.emission for caller in self.callers)

    @property
    def termination(self) -> tuple[Tensor, ...]:
        """(log(1 - ψ), log ψ) of each level, [N, T, k, 2]."""
        return tuple(link.table for link in self._termination_links())

    def _termination_links(self) -> tuple[Link, ...]:
        levels = zip(self.callers, self.termination_logits, strict=False)  # the meta-policy has none
        return tuple(
            LogTable(always_ending(level.shape)) if logit is None else Termination(logit) for level, logit in levels
        )

    def tables(self, actions: Tensor | None = None) -> LinkedTables:
        """The tables for controls [N, T, A] in scaled units; without them, of selections and terminations alone."""
        selection = (caller.selection_link for caller in self.callers)
        control = () if actions is None else tuple(caller.density_link(actions) for caller in self.callers)
        return LinkedTables(tuple(link for link in selection if link is not None), self._termination_links(), control)

    def tensors(self) -> list[Tensor]:
        """All outputs of the networks, each [N, T, ...]."""
        logits = [caller.logits for caller in self.callers if caller.logits is not None]
        numbers = [caller.numbers for caller in self.callers if caller.numbers is not None]
        return [*logits, *numbers, *(logit for logit in self.termination_logits if logit is not None)]

    def map(self, change: Callable[[Tensor], Tensor]) -> Outputs:
        """The outputs of changed tensors."""
        logits = (None if logit is None else change(logit) for logit in self.termination_logits)
        return Outputs(tuple(caller.map(change) for caller in self.callers), tuple(logits))
