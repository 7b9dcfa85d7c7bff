"""Do both engines agree? Asked before every fit, of the fit's own trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import enumeration, fused
from ddco_pyro.model.outputs import Outputs

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


def compare_engines(outputs: Outputs, actions: Tensor, lengths: Tensor) -> EngineCheck:
    """Value and gradient of the fused engine against Pyro's enumeration of the program.

    In float64, with respect to what the networks say. The engine eliminates tables; the program scores the controls by
    the emissions themselves.
    """
    controls = actions.double()
    truth = _evaluate(
        outputs,
        lambda said: enumeration.program_log_likelihood(said.tables(controls), lengths, said.emissions, controls),
    )
    fast = _evaluate(outputs, lambda said: fused.log_likelihood(said.tables(controls), lengths).sum())
    value = float((fast.value - truth.value).abs() / truth.value.abs().clamp(min=1.0))
    largest = truth.gradient.abs().max().clamp(min=1.0)
    return EngineCheck(value, float((fast.gradient - truth.gradient).abs().max() / largest))


class _Evaluation(NamedTuple):
    value: Tensor
    gradient: Tensor


def _evaluate(outputs: Outputs, engine: Callable[[Outputs], Tensor]) -> _Evaluation:
    leaves: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        leaves.append(tensor.detach().double().requires_grad_())
        return leaves[-1]

    value = engine(outputs.map(leaf))
    gradients = torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)
    return _Evaluation(value.detach(), torch.cat([gradient.flatten() for gradient in gradients]))
