"""Emissions: how the numbers that networks give a caller become a distribution of the control (paper §4.2).

The callers of a level share one emission object. It scores a control for each of them, draws one, and says how far
two of them are apart; nothing else in the project knows how a control is distributed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from ddco_pyro.model.tables import NEVER


class Steps(Protocol):
    """What the Pyro program scores or draws a control with at each step."""

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        ...

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s) of each caller for controls [..., A], [..., K]."""
        ...

    def steps(self) -> Sequence[Any]:
        """The same at each of T steps, from [N, T, K, A] to [N, K, A]; unbound once."""
        ...


class Emission(Steps, Protocol):
    """The controls of K callers, [..., K, A] in scaled units; log-densities are in the control's own units."""

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s) of each caller and dimension of controls [..., A], [..., K, A]."""
        ...

    @property
    def mode(self) -> Tensor:
        """The most likely control of each caller, [..., K, A]."""
        ...

    def draw(self, noise: Tensor) -> Tensor:
        """The controls [..., K, A] that standard normal numbers [..., A] stand for."""
        ...

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of KL(π_i ‖ π_j) and KL(π_j ‖ π_i) of two callers, [...] nats."""
        ...

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same of changed tensors."""
        ...


@dataclass(frozen=True)
class Gaussian:
    """a ~ N(μ, σ²), each dimension by itself (§4.2).

    :param mean: μ, [..., K, A] in scaled units.
    :param std: σ, [A] in scaled units.
    :param log_scale: logarithms of the control's units, [A].
    """

    mean: Tensor
    std: Tensor
    log_scale: Tensor

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return self.mean.shape

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²), [..., K, A]."""
        error = (actions.unsqueeze(-2) - self.mean) / self.std
        return -0.5 * (error.square() + math.log(2 * math.pi)) - self.std.log() - self.log_scale

    def log_density(self, actions: Tensor) -> Tensor:
        """log N(a; μ, σ²), [..., K]."""
        error = actions.unsqueeze(-2) - self.mean
        constant = self.std.log().sum(-1) + 0.5 * math.log(2 * math.pi) * len(self.std) + self.log_scale.sum(-1)
        return error.square() @ (-0.5 / self.std.square()).to(error.dtype) - constant

    @property
    def mode(self) -> Tensor:
        """μ."""
        return self.mean

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ·z."""
        return self.mean + self.std * noise.unsqueeze(-2)

    def divergence(self, i: int, j: int) -> Tensor:
        """½ Σ (μ_i - μ_j)² / σ²: both callers have the same σ."""
        apart = (self.mean[..., i, :] - self.mean[..., j, :]) / self.std
        return 0.5 * apart.double().square().sum(-1)

    def steps(self) -> list[Gaussian]:
        """The same at each step."""
        return [replace(self, mean=mean) for mean in self.mean.unbind(1)]

    def map(self, change: Callable[[Tensor], Tensor]) -> Gaussian:
        """The same of changed tensors."""
        return Gaussian(*(change(getattr(self, field.name)) for field in fields(self)))


@dataclass(frozen=True)
class Scored:
    """Controls of which only log-densities [..., K] are known: they have no dimensions, and cannot be drawn.

    With it the Pyro program of :mod:`ddco_pyro.model.ahmm` runs on :class:`ddco_pyro.model.tables.Tables`.
    """

    table: Tensor

    @property
    def shape(self) -> torch.Size:
        """[..., K, 0]."""
        return torch.Size([*self.table.shape, 0])

    def log_density(self, actions: Tensor) -> Tensor:
        """What is known, whatever the controls."""
        return self.table

    def steps(self) -> list[Scored]:
        """The same at each step."""
        return [Scored(table) for table in self.table.unbind(1)]


class Acting(TorchDistribution):
    """The control of whoever acts: the lowest level whose choice is not 0, else the meta-policy.

    :param emissions: of each level's options at one step, lowest first, the meta-policy's last, [N, K, A]; None for
        callers that emit no control, which the lowest level's always do.
    :param choices: (h^1, ..., h^D), each [..., N].
    """

    arg_constraints: ClassVar = {}
    support = constraints.real_vector

    def __init__(
        self,
        emissions: tuple[Any, ...],
        choices: tuple[Tensor, ...],
        validate_args: bool | None = None,
    ) -> None:
        self.emissions, self.choices = emissions, choices
        *batch, _, size = emissions[0].shape
        shape = torch.broadcast_shapes(batch, *(choice.shape for choice in choices))
        super().__init__(shape, torch.Size([size]), validate_args=validate_args)

    def expand(self, batch_shape: Sequence[int], _instance: Any = None) -> Acting:
        """The same for choices of a larger batch."""
        return Acting(self.emissions, tuple(choice.expand(batch_shape) for choice in self.choices), validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        """log π(a | s) of who acts; -inf for joint choices that cannot be."""
        control = torch.zeros((), dtype=torch.bool)
        impossible = control
        for choice in reversed(self.choices):
            impossible = impossible | (control & (choice > 0))
            control = control | (choice == 0)
        densities = [
            None if emission is None else emission.log_density(value).double().unsqueeze(-1)
            for emission in self.emissions
        ]
        density = self._of_actor(densities, NEVER).squeeze(-1)
        return torch.where(impossible, NEVER, density).expand(self.batch_shape)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """A control of who acts, [..., N, A] in scaled units."""
        return self.draw(torch.randn(*sample_shape, *self.batch_shape, *self.event_shape))

    def draw(self, noise: Tensor) -> Tensor:
        """The control [..., N, A] that standard normal numbers of this shape stand for."""
        with torch.no_grad():
            draws = [None if emission is None else emission.draw(noise) for emission in self.emissions]
            return self._of_actor(draws, torch.nan)

    @property
    def mode(self) -> Tensor:
        """The most likely control of who acts, [..., N, A] in scaled units."""
        return self._of_actor([None if emission is None else emission.mode for emission in self.emissions], torch.nan)

    def _of_actor(self, values: Sequence[Tensor | None], missing: float) -> Tensor:
        """Of values [..., N, K, E] of each level's callers those of who acts, [..., N, E]."""
        acting = torch.tensor([missing], dtype=torch.float64) if values[-1] is None else values[-1][..., 0, :]
        for own, choice in zip(reversed(values[:-1]), reversed(self.choices), strict=True):
            option = (
                torch.tensor([missing], dtype=torch.float64)
                if own is None
                else _of_caller(own, (choice - 1).clamp(min=0))
            )
            acting = torch.where((choice > 0).unsqueeze(-1), option, acting)
        return acting


def _of_caller(values: Tensor, caller: Tensor) -> Tensor:
    """Of values [..., K, E] those of one caller, [..., E]."""
    shape = torch.broadcast_shapes(values.shape[:-2], caller.shape)
    index = caller.expand(shape)[..., None, None].expand(*shape, 1, values.shape[-1])
    return values.expand(*shape, *values.shape[-2:]).gather(-2, index).squeeze(-2)
