"""What the networks of a hierarchy say about a batch, and the log-probabilities it stands for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddco_pyro.model.emissions import Emission
from ddco_pyro.model.links import log_selection, log_termination
from ddco_pyro.model.tables import NEVER, Tables


@dataclass(frozen=True)
class CallerOutputs:
    """What the K callers of one level say.

    :param options: k, the number of options that they select among; 0 for the lowest level.
    :param logits: of their choices [N, T, K, k], or [N, T, K, 1 + k] where control (choice 0) is one of them; None for
        callers that emit control alone.
    :param emission: how they emit the control, [N, T, K, A]; None for callers that emit none.
    :param numbers: what their network gave for that, [N, T, K, size]; None where there is none.
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
        """log η [N, T, K, 1 + k]; None where there is nothing to select."""
        if not self.options:
            return None
        if self.logits is not None:
            return log_selection(self.logits, 1 + self.options - self.logits.shape[-1])
        return pad(torch.zeros(*self.shape, 1), (0, self.options), value=NEVER)

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s) of each caller, [N, T, K]; -inf where it emits no control."""
        if self.emission is None:
            assert self.logits is not None  # a caller emits something
            return self.logits.new_full(self.logits.shape[:-1], NEVER)
        return self.emission.log_density(actions)


@dataclass(frozen=True)
class Outputs:
    """What all networks say about a batch, before any control is known.

    :param callers: each level's, lowest first, the meta-policy's last.
    :param termination_logits: of each level's options [N, T, k], before they are bounded; None for a level whose
        options end after every step.
    """

    callers: tuple[CallerOutputs, ...]
    termination_logits: tuple[Tensor | None, ...]

    @property
    def emissions(self) -> tuple[Emission | None, ...]:
        """How the callers of each level emit the control, lowest first, the meta-policy's last."""
        return tuple(caller.emission for caller in self.callers)

    @property
    def termination(self) -> tuple[Tensor, ...]:
        """(log(1 - ψ), log ψ) of each level, [N, T, k, 2]."""
        levels = zip(self.callers, self.termination_logits, strict=False)  # the meta-policy has none
        return tuple(_always(level.shape) if logit is None else log_termination(logit) for level, logit in levels)

    def tables(self, actions: Tensor | None = None) -> Tables:
        """The tables for controls [N, T, A] in scaled units; without them, of selections and terminations alone."""
        selection = (caller.selection for caller in self.callers)
        control = () if actions is None else tuple(caller.log_density(actions) for caller in self.callers)
        return Tables(tuple(table for table in selection if table is not None), self.termination, control)

    def tensors(self) -> list[Tensor]:
        """Everything that the networks say, each [N, T, ...]."""
        logits = [caller.logits for caller in self.callers if caller.logits is not None]
        numbers = [caller.numbers for caller in self.callers if caller.numbers is not None]
        return [*logits, *numbers, *(logit for logit in self.termination_logits if logit is not None)]

    def map(self, change: Callable[[Tensor], Tensor]) -> Outputs:
        """The same of changed tensors."""
        callers = (
            replace(
                caller,
                logits=None if caller.logits is None else change(caller.logits),
                emission=None if caller.emission is None else caller.emission.map(change),
                numbers=None if caller.numbers is None else change(caller.numbers),
            )
            for caller in self.callers
        )
        endings = (None if logit is None else change(logit) for logit in self.termination_logits)
        return Outputs(tuple(callers), tuple(endings))


def _always(shape: torch.Size) -> Tensor:
    """The termination table of options that end after every step, [N, T, k, 2]."""
    return torch.tensor([NEVER, 0.0]).expand(*shape, 2)
