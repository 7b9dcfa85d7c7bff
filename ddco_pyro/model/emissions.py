"""Emissions: how the numbers that networks give a caller become a distribution of the control (paper §4.2).

The callers of a level share one emission object. It scores a control for each of them, draws one, and says how far
two of them are apart; nothing else in the project knows how a control is distributed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Protocol, Self

import torch
from torch import Tensor

from ddco_pyro.model.links import weighted_squares

LOG_2PI = math.log(2 * math.pi)


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

    @property
    def numbers(self) -> Tensor:
        """What the network gave for each caller, [..., K, size]."""
        ...

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same of changed tensors."""
        ...


class Kind(ABC):
    """What all kinds share: tensors as fields, of which those over time are the first ones."""

    over_time: ClassVar[int] = 1
    """Number of fields of shape [N, T, K, ...]; the others are the same at every step."""

    @property
    def numbers(self) -> Tensor:
        """What the network gave for each caller, [..., K, size]."""
        numbers: Tensor = getattr(self, fields(self)[0].name)  # type: ignore[arg-type]
        return numbers

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]: a number for each dimension, unless a kind says otherwise."""
        return self.numbers.shape

    @abstractmethod
    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s) of each caller and dimension, [..., K, A]."""

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]: dimensions are independent given the caller, unless a kind says otherwise."""
        return self.by_dimension(actions).sum(-1)

    def steps(self) -> list[Self]:
        """The same at each step."""
        names = [field.name for field in fields(self)[: self.over_time]]  # type: ignore[arg-type]
        unbound = zip(*(getattr(self, name).unbind(1) for name in names), strict=True)
        return [replace(self, **dict(zip(names, tensors, strict=True))) for tensors in unbound]  # type: ignore[type-var]

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same of changed tensors."""
        return replace(self, **{field.name: change(getattr(self, field.name)) for field in fields(self)})  # type: ignore


@dataclass(frozen=True)
class Gaussian(Kind):
    """A free continuous control, a ~ N(μ, σ²), each dimension by itself (§4.2).

    :param mean: μ, [..., K, A] in scaled units.
    :param std: σ, [A], or [K, A] where each caller has its own, in scaled units.
    :param log_scale: logarithms of the control's units, [A].
    """

    mean: Tensor
    std: Tensor
    log_scale: Tensor

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²), [..., K, A]."""
        error = (actions.unsqueeze(-2) - self.mean) / self.std
        return -0.5 * (error.square() + LOG_2PI) - self.std.log() - self.log_scale

    def log_density(self, actions: Tensor) -> Tensor:
        """log N(a; μ, σ²), [..., K]."""
        constant = self.std.log().sum(-1) + 0.5 * LOG_2PI * self.std.shape[-1] + self.log_scale.sum(-1)
        weight = (-0.5 / self.std.square()).to(self.mean.dtype)
        return weighted_squares(self.mean, weight, actions) - constant.to(self.mean.dtype)

    @property
    def mode(self) -> Tensor:
        """μ."""
        return self.mean

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ·z."""
        return self.mean + self.std * noise.unsqueeze(-2)

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences; ½ Σ (μ_i - μ_j)² / σ² where callers share σ."""
        mean, std = self.mean.double(), self.std.double()
        apart = (mean[..., i, :] - mean[..., j, :]).square()
        first, second = (std, std) if std.dim() == 1 else (std[i], std[j])
        first, second = first.square(), second.square()
        return 0.25 * ((first + apart) / second + (second + apart) / first - 2).sum(-1)


@dataclass(frozen=True)
class Clipped(Kind):
    """A continuous control with bounds that it reaches: a = min(max(z, low), high) of z ~ N(μ, σ²), a censored normal.

    Within its bounds it has the normal's density; on a bound, or beyond, the probability of what lies there, Φ. That is
    a mass, whatever the units: densities and masses are different measures.

    :param mean: μ, [..., K, A] in scaled units; ``std`` and ``log_scale`` as those of :class:`Gaussian`.
    :param low: the lower bound of each dimension, -inf where it has none, [A] in scaled units; ``high`` likewise.
    """

    mean: Tensor
    std: Tensor
    log_scale: Tensor
    low: Tensor
    high: Tensor

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²) within the bounds, log Φ of what lies beyond on one of them, float64 [..., K, A]."""
        actions, mean, std = actions.double().unsqueeze(-2), self.mean.double(), self.std.double()
        inside = -0.5 * (((actions - mean) / std).square() + LOG_2PI) - std.log() - self.log_scale
        below, above = actions <= self.low, actions >= self.high
        if not bool((below | above).any()):
            return inside
        at = (below | above).expand(inside.shape).nonzero(as_tuple=True)  # elsewhere no Φ is asked for
        low, high, mean, std = (values.expand(inside.shape)[at] for values in (self.low, self.high, mean, std))
        beyond = torch.where(below.expand(inside.shape)[at], low - mean, mean - high) / std
        return inside.index_put(at, log_ndtr(beyond))

    @property
    def mode(self) -> Tensor:
        """μ within the bounds: the control without noise."""
        return self.mean.clamp(self.low, self.high)

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ·z within the bounds."""
        return (self.mean + self.std * noise.unsqueeze(-2)).clamp(self.low, self.high)

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences of the normals before they are clipped: an upper bound of those after."""
        return Gaussian(self.mean, self.std, self.log_scale).divergence(i, j)


@dataclass(frozen=True)
class Product:
    """Groups of dimensions, each of its own kind, independent given the caller.

    :param groups: the dimensions of each group, and their emission.
    """

    groups: tuple[tuple[tuple[int, ...], Emission], ...]

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        size = sum(len(dimensions) for dimensions, _ in self.groups)
        return torch.Size([*self.groups[0][1].shape[:-1], size])

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s) of each caller and dimension, [..., K, A]."""
        return self._joined([emission.by_dimension(actions[..., dims]) for dims, emission in self.groups])

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]."""
        return sum_of([emission.log_density(actions[..., dims]) for dims, emission in self.groups])

    @property
    def numbers(self) -> Tensor:
        """What the network gave for each caller, group after group."""
        return torch.cat([emission.numbers for _, emission in self.groups], dim=-1)

    @property
    def mode(self) -> Tensor:
        """The most likely control of each group."""
        return self._joined([emission.mode for _, emission in self.groups])

    def draw(self, noise: Tensor) -> Tensor:
        """The controls that standard normal numbers stand for, each group's own."""
        return self._joined([emission.draw(noise[..., dims]) for dims, emission in self.groups])

    def divergence(self, i: int, j: int) -> Tensor:
        """The sum of the groups' divergences."""
        return sum_of([emission.divergence(i, j) for _, emission in self.groups])

    def steps(self) -> list[Product]:
        """The same at each step."""
        each = zip(*(emission.steps() for _, emission in self.groups), strict=True)
        names = [dimensions for dimensions, _ in self.groups]
        return [Product(tuple(zip(names, emissions, strict=True))) for emissions in each]

    def map(self, change: Callable[[Tensor], Tensor]) -> Product:
        """The same of changed tensors."""
        return Product(tuple((dimensions, emission.map(change)) for dimensions, emission in self.groups))

    def _joined(self, values: Sequence[Tensor]) -> Tensor:
        """The groups' values [..., K, A_g] in the order of the dimensions."""
        order = torch.tensor([dimension for dimensions, _ in self.groups for dimension in dimensions]).argsort()
        return torch.cat(list(values), dim=-1)[..., order]


def sum_of(values: Sequence[Tensor]) -> Tensor:
    """The sum of one or more tensors."""
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total


TAIL = -30.0
"""Below, log Φ is computed by its asymptotic series: torch's own loses its gradient to rounding from -1e8 on."""


def log_ndtr(values: Tensor) -> Tensor:
    """log Φ(x) in float64, with a gradient that is finite however small x is; float32 gives NaN in training."""
    x = values.double()
    tail = x.clamp(max=TAIL)
    r = tail.square().reciprocal()
    series = -0.5 * tail.square() - (-tail).log() - 0.5 * LOG_2PI + (-r * (1 - 3 * r * (1 - 5 * r))).log1p()
    return torch.where(x < TAIL, series, torch.special.log_ndtr(x.clamp(min=TAIL)))
