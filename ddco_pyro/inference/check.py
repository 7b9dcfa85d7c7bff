"""Do both engines agree? Asked before every fit, of the fit's own trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import direct, enumeration, fused
from ddco_pyro.model.ahmm import Tables, complete
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


def compare_engines(outputs: Outputs, actions: Tensor, log_volume: Tensor, lengths: Tensor) -> EngineCheck:
    """Value and gradient of the fused engine, with and without tables in between, against Pyro's enumeration.

    On the first steps of the first trajectories, in float64, with respect to what the networks say.
    """
    few = lengths[:TRAJECTORIES].clamp(max=STEPS)
    short = Outputs.of(outputs.options, [_cut(leaf, len(few), int(few.max())) for leaf in outputs.leaves()])
    controls = actions[: len(few), : int(few.max())].double()
    truth = _evaluate(short, lambda one: _enumerated(one.tables(controls, log_volume), few))
    found = (
        _evaluate(short, lambda one: direct.log_likelihood(one, controls, log_volume, few).sum()),
        _evaluate(short, lambda one: fused.log_likelihood(one.tables(controls, log_volume), few).sum()),
    )
    value = max(float((one.value - truth.value).abs() / truth.value.abs().clamp(min=1.0)) for one in found)
    largest = truth.gradient.abs().max().clamp(min=1.0)
    return EngineCheck(value, max(float((one.gradient - truth.gradient).abs().max() / largest) for one in found))


class _Evaluation(NamedTuple):
    value: Tensor
    gradient: Tensor


def _cut(leaf: Tensor | None, rows: int, steps: int) -> Tensor | None:
    """A leaf's first steps; a standard deviation has none."""
    if leaf is None:
        return None
    return (leaf[:rows, :steps] if leaf.dim() > 1 else leaf).detach().double().requires_grad_()


def _enumerated(tables: Tables, lengths: Tensor) -> Tensor:
    return enumeration.total_log_likelihood(complete(tables, lengths))


def _evaluate(outputs: Outputs, engine: Callable[[Outputs], Tensor]) -> _Evaluation:
    leaves = [leaf for leaf in outputs.leaves() if leaf is not None]
    value = engine(outputs)
    gradients = torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)
    return _Evaluation(value.detach(), torch.cat([gradient.flatten() for gradient in gradients]))
