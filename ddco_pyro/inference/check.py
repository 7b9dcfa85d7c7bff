"""Do both engines agree? Asked before every fit, of the fit's own trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.ahmm import NEVER, Tables, complete
from ddco_pyro.inference import enumeration, fused

TRAJECTORIES = 3
STEPS = 12
TOLERANCE = 1e-6


class EngineCheck(NamedTuple):
    """Largest relative differences between the engines, in the log-likelihood and in its gradient."""

    value: float
    gradient: float

    @property
    def agrees(self) -> bool:
        """Whether both differences are within the tolerance (NaN is not)."""
        return self.value <= TOLERANCE and self.gradient <= TOLERANCE


def compare_engines(tables: Tables, lengths: Tensor) -> EngineCheck:
    """Value and gradient (with respect to the tables) of both engines, on the first steps of the first trajectories."""
    few = lengths[:TRAJECTORIES].clamp(max=STEPS)
    short = _cut(tables, len(few), int(few.max()))
    fused_value, fused_gradient = _evaluate(short, few, lambda t, n: fused.log_likelihood(t, n).sum())
    pyro_value, pyro_gradient = _evaluate(short, few, lambda t, n: enumeration.total_log_likelihood(complete(t, n)))
    value = (fused_value - pyro_value).abs() / pyro_value.abs().clamp(min=1.0)
    gradient = (fused_gradient - pyro_gradient).abs().max() / pyro_gradient.abs().max().clamp(min=1.0)
    return EngineCheck(float(value), float(gradient))


def _cut(tables: Tables, rows: int, steps: int) -> Tables:
    def cut(level: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        return tuple(table[:rows, :steps].detach().double().requires_grad_() for table in level)

    return Tables(cut(tables.selection), cut(tables.termination), cut(tables.control))


def _evaluate(tables: Tables, lengths: Tensor, engine: Callable[[Tables, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    leaves = [*tables.selection, *tables.termination, *tables.control]
    value = engine(tables, lengths)
    gradients = torch.autograd.grad(value, leaves, allow_unused=True)
    possible = [
        gradient[leaf > NEVER].flatten()  # an impossible entry has no logarithm to differentiate by
        for leaf, gradient in zip(leaves, gradients, strict=True)
        if gradient is not None
    ]
    return value.detach(), torch.cat(possible)
