"""The likelihood by either engine, and the check of one against the other that precedes every fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ddco_pyro.inference import enumeration, fused, logspace
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables, complete

Engine = Literal["fused", "enumerate"]

TRAJECTORIES = 3
"""Trajectories of a fit that the engines are compared on."""

STEPS = 12
"""First steps of those trajectories that the engines are compared on."""

TOLERANCE = 1e-6
"""Largest relative difference between engines that agree."""


def log_likelihood(tables: Tables, lengths: Tensor, engine: Engine = "fused") -> Tensor:
    """log p(ξ) of each trajectory in nats, [N] float64, differentiable in the tables; -inf where ξ is impossible.

    Without dynamics: p(ξ) is Σ_ζ p(ζ, a | s) of §4.1. The fused engine is differentiable once.

    :param lengths: steps of each trajectory, int64 [N]; steps beyond are ignored.

    >>> import torch
    >>> from ddco_pyro.inference import log_likelihood
    >>> from ddco_pyro.model.tables import Tables
    >>> tables = Tables(  # one level of two options, which always end: log 0.5 and log 1 for each step
    ...     selection=(torch.tensor([0.0, 0.5, 0.5]).log().expand(1, 4, 1, 3),),  # control, option 1, option 2
    ...     termination=(torch.tensor([0.0, 1.0]).log().expand(1, 4, 2, 2),),  # 1 - ψ and ψ of both options
    ...     control=(torch.tensor([1.0, 3.0]).log().expand(1, 4, 2), torch.full((1, 4, 1), -torch.inf)),
    ... )
    >>> log_likelihood(tables, torch.tensor([4])).exp()  # (0.5 · 1 + 0.5 · 3) ** 4
    tensor([16.0000], dtype=torch.float64)
    """
    if engine == "enumerate":
        return enumeration.log_likelihood(tables, lengths)
    if lengths.device.type == "cpu":
        return fused.log_likelihood(tables, lengths)
    return logspace.log_likelihood(complete(tables, lengths))


class EngineCheck(NamedTuple):
    """Largest relative differences between the engines, in the log-likelihood and in its gradient."""

    value: float
    gradient: float

    @property
    def agrees(self) -> bool:
        """Whether both differences are within the tolerance (NaN is not)."""
        return self.value <= TOLERANCE and self.gradient <= TOLERANCE


def compare_engines(outputs: Outputs, actions: Tensor, lengths: Tensor) -> EngineCheck:
    """Compare value and gradient of the fused engine with Pyro's enumeration of the program, in float64.

    Gradients are with respect to the networks' outputs. The fused engine eliminates tables; the program scores the
    controls [N, T, A] by the emissions themselves.
    """
    controls = actions.double()

    def by_program(said: Outputs) -> Tensor:
        return enumeration.log_likelihood(said.tables(controls), lengths, said.emissions, controls)

    truth, slopes = _with_gradient(outputs, by_program)
    value, gradient = _with_gradient(outputs, lambda said: log_likelihood(said.tables(controls), lengths))
    return EngineCheck(
        float((value - truth).abs() / truth.abs().clamp(min=1.0)),
        float((gradient - slopes).abs().max() / slopes.abs().max().clamp(min=1.0)),
    )


def _with_gradient(outputs: Outputs, engine: Callable[[Outputs], Tensor]) -> tuple[Tensor, Tensor]:
    """The sum of an engine's log-likelihoods, and its gradient, flat."""
    leaves: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        leaves.append(tensor.detach().double().requires_grad_())
        return leaves[-1]

    value = engine(outputs.map(leaf)).sum()
    gradients = torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)
    return value.detach(), torch.cat([gradient.flatten() for gradient in gradients])
