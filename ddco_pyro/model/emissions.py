"""Emissions: how the numbers that networks give a caller become a distribution of the control (paper §4.2).

The callers of a level share one emission object. It scores a control for each of them, draws one, and says how far
two of them are apart; nothing else in the project knows how a control is distributed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, Self

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid
from torch.special import ndtr

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

    @property
    def noise(self) -> int:
        """How many standard normal numbers a control is drawn from."""
        ...

    def draw(self, noise: Tensor) -> Tensor:
        """The controls [..., K, A] that standard normal numbers [..., noise] stand for."""
        ...

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of KL(π_i ‖ π_j) and KL(π_j ‖ π_i) of two callers, [...] nats."""
        ...

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same of changed tensors."""
        ...


class Kind(ABC):
    """What all kinds share: tensors as fields, the first one [..., K, ...], others like it or the same at all steps."""

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]: a number for each dimension, unless a kind says otherwise."""
        first: Tensor = getattr(self, fields(self)[0].name)  # type: ignore[arg-type]
        return first.shape

    @property
    def noise(self) -> int:
        """A: a standard normal number for each dimension."""
        return self.shape[-1]

    @abstractmethod
    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s) of each caller and dimension, [..., K, A]."""

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]: dimensions are independent given the caller, unless a kind says otherwise."""
        return self.by_dimension(actions).sum(-1)

    def steps(self) -> list[Self]:
        """The same at each step: fields with as many dimensions as the first one differ from step to step."""
        each = {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
        names = [name for name, tensor in each.items() if tensor.dim() == next(iter(each.values())).dim()]
        unbound = zip(*(each[name].unbind(1) for name in names), strict=True)
        return [replace(self, **dict(zip(names, tensors, strict=True))) for tensors in unbound]  # type: ignore[type-var]

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same of changed tensors."""
        return replace(self, **{field.name: change(getattr(self, field.name)) for field in fields(self)})  # type: ignore


@dataclass(frozen=True)
class Gaussian(Kind):
    """A free continuous control, a ~ N(μ, σ²), each dimension by itself (§4.2).

    :param mean: μ, [..., K, A] in scaled units.
    :param std: σ, [A], [K, A] where each caller has its own, or [..., K, A] where it depends on the state, in scaled
        units.
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
        return 0.5 * (self.relative_entropy(i, j) + self.relative_entropy(j, i))

    def relative_entropy(self, i: int, j: int) -> Tensor:
        """KL(π_i ‖ π_j) of two callers, [...] nats."""
        mean, std = self.mean.double(), self.std.double()
        apart = (mean[..., i, :] - mean[..., j, :]).square()
        first, second = (std, std) if std.dim() == 1 else (std[..., i, :], std[..., j, :])
        return (0.5 * (first.square() + apart) / second.square() - 0.5 + second.log() - first.log()).sum(-1)


@dataclass(frozen=True)
class Clipped(Gaussian):
    """A continuous control with bounds that it reaches: a = min(max(z, low), high) of z ~ N(μ, σ²), a censored normal.

    Within its bounds it has the normal's density; on a bound, or beyond, the probability of what lies there, Φ. That is
    a mass, whatever the units: densities and masses are different measures. Divergences are those of the normals before
    they are clipped, upper bounds of those after.

    :param low: the lower bound of each dimension, -inf where it has none, [A] in scaled units; ``high`` likewise.
    """

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

    def log_density(self, actions: Tensor) -> Tensor:
        """The sum over dimensions, float64 [..., K]."""
        return self.by_dimension(actions).sum(-1)

    @property
    def mode(self) -> Tensor:
        """μ within the bounds: the control without noise."""
        return self.mean.clamp(self.low, self.high)

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ·z within the bounds."""
        return (self.mean + self.std * noise.unsqueeze(-2)).clamp(self.low, self.high)


@dataclass(frozen=True)
class Hurdle:
    """A two-part control: exactly one value with probability p = logistic(y), continuous otherwise (a hurdle model).

    All dimensions are at their values at once, or none is. The value is 0 in scaled units, and nothing else is, so the
    comparison is exact at any scale.

    :param logit: y, [..., K, 1].
    :param slab: the continuous part.
    """

    logit: Tensor
    slab: Gaussian

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return self.slab.shape

    @property
    def noise(self) -> int:
        """A + 1: the last one decides which part a control is of."""
        return self.slab.noise + 1

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s), [..., K, A]: each dimension has its share of which part a control is of."""
        at = _at_value(actions).unsqueeze(-1)
        return self._part(at) / self.shape[-1] + torch.where(at, 0.0, self.slab.by_dimension(actions))

    def log_density(self, actions: Tensor) -> Tensor:
        """log p at the value, log (1 - p) and the slab's log-density elsewhere, [..., K]."""
        at = _at_value(actions)
        return self._part(at.unsqueeze(-1)).squeeze(-1) + torch.where(at, 0.0, self.slab.log_density(actions))

    def _part(self, at: Tensor) -> Tensor:
        """The log-probability of being at the value, or of not being there, [..., K, 1]."""
        return logsigmoid(torch.where(at, self.logit, -self.logit))

    @property
    def mode(self) -> Tensor:
        """The mode of the more likely part."""
        return torch.where(self.logit >= 0, 0.0, self.slab.mode)

    def draw(self, noise: Tensor) -> Tensor:
        """The value where Φ(z) of the last number is less than p; elsewhere what the slab draws from the others."""
        at = ndtr(noise[..., -1:]).unsqueeze(-2) < self.logit.sigmoid()
        return torch.where(at, 0.0, self.slab.draw(noise[..., :-1]))

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences: of which part it is, and of the slabs as often as these are seen."""
        first, second = (self.logit[..., caller, 0].double() for caller in (i, j))
        part = 0.5 * (first.sigmoid() - second.sigmoid()) * (first - second)
        slabs = (
            (-first).sigmoid() * self.slab.relative_entropy(i, j),
            (-second).sigmoid() * self.slab.relative_entropy(j, i),
        )
        return part + 0.5 * sum_of(slabs)

    def steps(self) -> list[Hurdle]:
        """The same at each step."""
        return [Hurdle(*parts) for parts in zip(self.logit.unbind(1), self.slab.steps(), strict=True)]

    def map(self, change: Callable[[Tensor], Tensor]) -> Hurdle:
        """The same of changed tensors."""
        return Hurdle(change(self.logit), self.slab.map(change))


def _at_value(actions: Tensor) -> Tensor:
    """Whether a hurdle's controls [..., A] are at its value, [..., 1]."""
    return (actions == 0).all(-1, keepdim=True)


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
    def mode(self) -> Tensor:
        """The most likely control of each group."""
        return self._joined([emission.mode for _, emission in self.groups])

    @property
    def noise(self) -> int:
        """The sum of the groups' numbers."""
        return sum(emission.noise for _, emission in self.groups)

    def draw(self, noise: Tensor) -> Tensor:
        """The controls that standard normal numbers stand for: the first A each dimension's, then what groups add."""
        draws, first = [], self.shape[-1]
        for dimensions, emission in self.groups:
            last = first + emission.noise - len(dimensions)
            draws.append(emission.draw(noise[..., [*dimensions, *range(first, last)]]))
            first = last
        return self._joined(draws)

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
