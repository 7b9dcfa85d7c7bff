"""What the networks of a hierarchy say about a batch, as they say it, and the log-probabilities it stands for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, pad

from ddco_pyro.model.ahmm import NEVER, Tables

TERMINATION_BOUND = 12.0
"""Termination logits lie within ±12 (ψ between 6e-6 and 1 - 6e-6), so no path's probability is ever exactly 0."""


@dataclass(frozen=True)
class Decision:
    """What the K callers of one level say.

    :param options: k, the number of options that they select among; 0 for the lowest level.
    :param logits: of their choices [N, T, K, k], or [N, T, K, 1 + k] where control (choice 0) is one of them; None for
        callers that emit control alone.
    :param mean: the mean control [N, T, K, A] in scaled units; None for callers that emit none.
    :param std: its standard deviation [A].
    """

    options: int
    logits: Tensor | None
    mean: Tensor | None
    std: Tensor

    @property
    def selection(self) -> Tensor | None:
        """log η [N, T, K, 1 + k]; None where there is nothing to select."""
        if not self.options:
            return None
        if self.logits is not None:
            return pad(self.logits.log_softmax(-1), (1 + self.options - self.logits.shape[-1], 0), value=NEVER)
        assert self.mean is not None  # a caller emits something
        control = self.mean.new_zeros(*self.mean.shape[:-1], 1)
        return pad(control, (0, self.options), value=NEVER)

    def log_constant(self, log_volume: Tensor | float) -> Tensor:
        """The logarithm of the Gaussian's normaliser, so that densities are in the control's own units."""
        return -(self.std.log().sum(-1) + 0.5 * math.log(2 * math.pi) * len(self.std) + log_volume)

    def log_density(self, actions: Tensor, log_volume: Tensor) -> Tensor:
        """log N(a; μ, σ²) of each caller, [N, T, K], in the control's own units; -inf where it emits no control."""
        if self.mean is None:
            assert self.logits is not None  # a caller emits something
            return self.logits.new_full(self.logits.shape[:-1], NEVER)
        error = actions.unsqueeze(2) - self.mean
        return error.square() @ (-0.5 / self.std.square()).to(error.dtype) + self.log_constant(log_volume)


@dataclass(frozen=True)
class Outputs:
    """What all networks say about a batch, before any control is known.

    :param decisions: each level's, lowest first, the top caller's last.
    :param endings: logits of the terminations of each level's options [N, T, k], before they are bounded.
    """

    decisions: tuple[Decision, ...]
    endings: tuple[Tensor, ...]

    @property
    def options(self) -> tuple[int, ...]:
        """The number of options that each decision is about."""
        return tuple(one.options for one in self.decisions)

    @property
    def termination(self) -> tuple[Tensor, ...]:
        """(log(1 - ψ), log ψ) of each level, [N, T, k, 2]."""
        logits = (bounded(ending) for ending in self.endings)
        return tuple(torch.stack([logsigmoid(-logit), logsigmoid(logit)], dim=-1) for logit in logits)

    def tables(self, actions: Tensor, log_volume: Tensor) -> Tables:
        """The tables for controls [N, T, A] in scaled units; densities in the control's own units."""
        found = (one.selection for one in self.decisions)
        control = tuple(one.log_density(actions, log_volume) for one in self.decisions)
        return Tables(tuple(one for one in found if one is not None), self.termination, control)

    def leaves(self) -> tuple[Tensor | None, ...]:
        """Every tensor: the decisions' logits, means and deviations, and the endings."""
        each = [(one.logits, one.mean, one.std) for one in self.decisions]
        return (*(leaf for group in zip(*each, strict=True) for leaf in group), *self.endings)

    @classmethod
    def of(cls, options: Sequence[int], leaves: Sequence[Tensor | None]) -> Outputs:
        """Outputs from their :attr:`options` and :meth:`leaves`."""
        size = len(options)
        groups = (leaves[start : start + size] for start in (0, size, 2 * size))
        decisions = tuple(
            Decision(k, logits, mean, std)
            for k, logits, mean, std in zip(options, *groups, strict=True)
            if std is not None
        )
        return cls(decisions, tuple(leaf for leaf in leaves[3 * size :] if leaf is not None))


def bounded(logit: Tensor) -> Tensor:
    """Termination logits within ±``TERMINATION_BOUND``, by a scaled tanh."""
    return TERMINATION_BOUND * torch.tanh(logit / TERMINATION_BOUND)
