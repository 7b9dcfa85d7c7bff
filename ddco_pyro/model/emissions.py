"""Emissions: how the numbers that networks give a caller become a distribution of the control (paper §4.2).

The callers of a level share one emission object, and no other module knows how a control is distributed. Controls are
in scaled units; log-densities are in the control's own units.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import reduce
from operator import add
from typing import Any, Protocol, Self

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, one_hot, pad
from torch.special import ndtr

from ddco_pyro.model.tables import NEVER

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
        """One emission [N, K, A] for each of T steps, from [N, T, K, A]; unbound once."""
        ...


class Emission(ABC):
    """The distributions of the controls of K callers, [..., K, A].

    A kind is a dataclass of tensors [..., K, ...], of tensors that are the same at all steps, and of other emissions.
    The first field is a tensor [..., K, ...].
    """

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]: that of the first field, unless a kind says otherwise."""
        first: Tensor = next(iter(self._fields().values()))
        return first.shape

    @property
    def noise(self) -> int:
        """How many standard normal numbers a control is drawn from: A, unless a kind says otherwise."""
        return self.shape[-1]

    @abstractmethod
    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s) of each caller and dimension of controls [..., A], [..., K, A]."""

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s) [..., K]: dimensions are independent given the caller, unless a kind says otherwise."""
        return self.by_dimension(actions).sum(-1)

    @property
    @abstractmethod
    def mode(self) -> Tensor:
        """The most likely control of each caller, [..., K, A]."""

    @abstractmethod
    def draw(self, noise: Tensor) -> Tensor:
        """The controls [..., K, A] that standard normal numbers [..., noise] stand for."""

    @abstractmethod
    def divergence(self, i: int) -> Tensor:
        """Mean of KL(π_i ‖ π_j) and KL(π_j ‖ π_i) of caller i and each caller j, float64 [..., K] nats."""

    def steps(self) -> list[Self]:
        """One emission for each step: tensors with as many dimensions as the first field differ from step to step."""
        each = self._fields()
        dimensions = next(iter(each.values())).dim()
        by_step = {
            name: value.unbind(1) if isinstance(value, Tensor) else value.steps()
            for name, value in each.items()
            if isinstance(value, Emission) or value.dim() == dimensions
        }
        return [replace(self, **dict(zip(by_step, now, strict=True))) for now in zip(*by_step.values(), strict=True)]  # type: ignore[type-var]

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The emission of changed tensors."""
        changed = {
            name: change(value) if isinstance(value, Tensor) else value.map(change)
            for name, value in self._fields().items()
        }
        return replace(self, **changed)  # type: ignore[type-var]

    def tensors(self) -> tuple[Tensor, ...]:
        """The floating-point tensors, those of other emissions included."""
        found: list[Tensor] = []
        for value in self._fields().values():
            own = (value,) if isinstance(value, Tensor) else value.tensors()
            found.extend(tensor for tensor in own if tensor.is_floating_point())
        return tuple(found)

    def _fields(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]


@dataclass(frozen=True)
class Gaussian(Emission):
    """A free continuous control, a ~ N(μ, σ²), with independent dimensions (§4.2).

    :param mean: μ, [..., K, A].
    :param std: σ, [A]; [K, A] for a σ of each caller; [..., K, A] for a σ that depends on the state.
    :param log_scale: logarithms of the control's units, [A].
    """

    mean: Tensor
    std: Tensor
    log_scale: Tensor

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²), [..., K, A]."""
        return self._each(actions).unflatten(-1, self.shape[-2:])

    def log_density(self, actions: Tensor) -> Tensor:
        """log N(a; μ, σ²), [..., K]."""
        callers, size = self.shape[-2:]
        return self._each(actions) @ torch.eye(callers, dtype=self.mean.dtype).repeat_interleave(size, 0)

    def _each(self, actions: Tensor) -> Tensor:
        """:meth:`by_dimension`, [..., K·A]: products with zeros and ones take a fifth of the time of broadcasting."""
        return self._scored(self._errors(actions))

    def _scored(self, errors: Tensor) -> Tensor:
        return -0.5 * errors.square() - self._wide(self.std.log() + self.log_scale + 0.5 * LOG_2PI)

    def _errors(self, actions: Tensor) -> Tensor:
        """(a_d - μ_d) / σ_d, [..., K·A]."""
        return (self._repeated(actions) - self.mean.flatten(-2)) * self._wide(1 / self.std)

    def _repeated(self, actions: Tensor) -> Tensor:
        """[..., A] for each caller, [..., K·A]."""
        callers, size = self.shape[-2:]
        return actions.to(self.mean.dtype) @ torch.eye(size, dtype=self.mean.dtype).repeat(1, callers)

    def _wide(self, values: Tensor) -> Tensor:
        """[A], [K, A] or [..., K, A] as [..., K·A]."""
        return values.expand(*values.shape[:-2], *self.shape[-2:]).flatten(-2).to(self.mean.dtype)

    @property
    def mode(self) -> Tensor:
        """μ."""
        return self.mean

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ·z."""
        return self.mean + self.std * noise.unsqueeze(-2)

    def divergence(self, i: int) -> Tensor:
        """½ Σ (μ_i - μ_j)² / σ² where callers share σ."""
        square, ratio, precision = self._beside(i)
        both = (square * (precision + precision[..., i : i + 1, :])).sum(-1)
        return 0.25 * (both + (ratio + 1 / ratio - 2).sum(-1))

    def relative_entropies(self, i: int) -> tuple[Tensor, Tensor]:
        """KL(π_i ‖ π_j) and KL(π_j ‖ π_i) of caller i and each caller j, float64 [..., K] nats."""
        square, ratio, precision = self._beside(i)
        to = (square * precision).sum(-1) + (1 / ratio + ratio.log() - 1).sum(-1)
        back = (square * precision[..., i : i + 1, :]).sum(-1) + (ratio - ratio.log() - 1).sum(-1)
        return 0.5 * to, 0.5 * back

    def _beside(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
        """(μ_j - μ_i)² [..., K, A], and σ_j² / σ_i² and 1 / σ_j², which steps may share."""
        mean = self.mean.double()
        variance = self.std.double().square().expand(*self.std.shape[:-2], *self.shape[-2:])
        return (mean - mean[..., i : i + 1, :]).square(), variance / variance[..., i : i + 1, :], 1 / variance


@dataclass(frozen=True)
class Clipped(Gaussian):
    """A continuous control that reaches its bounds: a = min(max(z, low), high) of z ~ N(μ, σ²), a censored normal.

    Within its bounds a control has the normal's density. On a bound, or beyond, it has the probability Φ of what lies
    there. That is a mass, whatever the units: densities and masses are different measures. Divergences are those of
    the normals before clipping, upper bounds of those after.

    :param low: the lower bound of each dimension in scaled units, -inf for none, [A]; ``high`` likewise.
    """

    low: Tensor
    high: Tensor

    def _each(self, actions: Tensor) -> Tensor:
        """log N(a_d; μ_d, σ_d²) within the bounds, log Φ of what lies beyond on a bound, [..., K·A]."""
        side = self._repeated((actions <= self.low).float() - (actions >= self.high).float()).flatten()
        on = side.nonzero().squeeze(1)  # log Φ is computed on bounds alone
        errors = self._errors(actions.clamp(self.low, self.high))
        mass = log_ndtr(errors.flatten().index_select(0, on) * side[on]).to(errors.dtype)
        each = self._scored(errors)
        return each.flatten().index_copy(0, on, mass).reshape(each.shape)

    @property
    def mode(self) -> Tensor:
        """μ within the bounds: the control without noise."""
        return self.mean.clamp(self.low, self.high)

    def draw(self, noise: Tensor) -> Tensor:
        """μ + σ·z within the bounds."""
        return super().draw(noise).clamp(self.low, self.high)


@dataclass(frozen=True)
class Hurdle(Emission):
    """A two-part control: exactly one value with probability p = logistic(y), continuous otherwise (a hurdle model).

    All dimensions are at their values at once, or none is. The value is 0 in scaled units, and no other control is, so
    the comparison is exact at any scale.

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
        """A + 1: the last one decides between the parts."""
        return self.slab.noise + 1

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s), [..., K, A]: each dimension has an equal share of the log-probability of the part."""
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

    def divergence(self, i: int) -> Tensor:
        """That of the parts, and that of the slabs weighted by 1 - p."""
        each = self.logit[..., 0].double()
        own, (to, back) = each[..., i : i + 1], self.slab.relative_entropies(i)
        return _of_switch(own, each) + 0.5 * ((-own).sigmoid() * to + (-each).sigmoid() * back)


def _at_value(actions: Tensor) -> Tensor:
    """Whether a hurdle's controls [..., A] are at its value, [..., 1]."""
    return (actions == 0).all(-1, keepdim=True)


def _of_switch(first: Tensor, second: Tensor) -> Tensor:
    """The divergence ½ (p_i - p_j)(y_i - y_j) of two switches, also where torch's own is infinite by rounding."""
    return 0.5 * (first.sigmoid() - second.sigmoid()) * (first - second)


@dataclass(frozen=True)
class Binary(Emission):
    """Switches, each on (1) with probability logistic(y) and off (0) otherwise.

    :param logits: y, [..., K, A].
    """

    logits: Tensor

    def by_dimension(self, actions: Tensor) -> Tensor:
        """The log-probability of each switch's position, [..., K, A]; -inf for values other than 0 and 1."""
        actions = actions.unsqueeze(-2)
        position = logsigmoid(torch.where(actions > 0.5, self.logits, -self.logits))
        return torch.where((actions == 0) | (actions == 1), position, NEVER)

    @property
    def mode(self) -> Tensor:
        """The more likely position."""
        return (self.logits > 0).to(self.logits.dtype)

    def draw(self, noise: Tensor) -> Tensor:
        """On where Φ(z) is less than logistic(y)."""
        return (ndtr(noise).unsqueeze(-2) < self.logits.sigmoid()).to(self.logits.dtype)

    def divergence(self, i: int) -> Tensor:
        """½ Σ (p_i - p_j)(y_i - y_j)."""
        logits = self.logits.double()
        return _of_switch(logits[..., i : i + 1, :], logits).sum(-1)


@dataclass(frozen=True)
class Categorical(Emission):
    """One of C discrete actions, as its index (A = 1) or, where A = C, as a row with a single 1.

    :param logits: [..., K, C].
    :param rows: whether actions are rows; a tensor with one truth value.
    """

    logits: Tensor
    rows: Tensor

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return torch.Size([*self.logits.shape[:-1], self.logits.shape[-1] if bool(self.rows) else 1])

    def by_dimension(self, actions: Tensor) -> Tensor:
        """log softmax(logits)[a], [..., K, A]: in the first dimension, 0 in the others; -inf for no such action."""
        index, possible = self._index(actions)
        log_probs = self.logits.log_softmax(-1)
        chosen = log_probs.gather(-1, index.unsqueeze(-2).expand(*log_probs.shape[:-1], 1))
        return pad(torch.where(possible.unsqueeze(-2), chosen, NEVER), (0, self.shape[-1] - 1))

    def tensors(self) -> tuple[Tensor, ...]:
        """The logits; ``rows`` is a truth value, whatever its type."""
        return (self.logits,)

    def _index(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """The index of each action [..., A], and whether there is such an action, [..., 1]."""
        classes = self.logits.shape[-1]
        index = actions.argmax(-1, keepdim=True) if bool(self.rows) else actions.clamp(0, classes - 1).long()
        meant = one_hot(index.squeeze(-1), classes) if bool(self.rows) else index
        return index, (actions == meant).all(-1, keepdim=True)

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]."""
        return self.by_dimension(actions)[..., 0]

    @property
    def mode(self) -> Tensor:
        """The most likely action."""
        return self._action(self.logits.argmax(-1))

    def draw(self, noise: Tensor) -> Tensor:
        """The first action up to which the probabilities sum to more than Φ(z) of the first number."""
        total = self.logits.double().softmax(-1).cumsum(-1)
        uniform = ndtr(noise[..., :1].double()).unsqueeze(-2)
        return self._action((total <= uniform * total[..., -1:]).sum(-1).clamp(max=total.shape[-1] - 1))

    def divergence(self, i: int) -> Tensor:
        """½ Σ (p_i - p_j)(log p_i - log p_j)."""
        each = self.logits.double().log_softmax(-1)
        own = each[..., i : i + 1, :]
        return 0.5 * ((own.exp() - each.exp()) * (own - each)).sum(-1)

    def _action(self, index: Tensor) -> Tensor:
        actions = one_hot(index, self.logits.shape[-1]) if bool(self.rows) else index.unsqueeze(-1)
        return actions.to(self.logits.dtype)


@dataclass(frozen=True)
class Product(Emission):
    """Groups of control dimensions with a kind each, independent given the caller.

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
        return reduce(add, (emission.log_density(actions[..., dims]) for dims, emission in self.groups))

    def tensors(self) -> tuple[Tensor, ...]:
        """Those of the groups."""
        return tuple(tensor for _, emission in self.groups for tensor in emission.tensors())

    @property
    def mode(self) -> Tensor:
        """The most likely control of each group."""
        return self._joined([emission.mode for _, emission in self.groups])

    @property
    def noise(self) -> int:
        """The sum of the groups' numbers."""
        return sum(emission.noise for _, emission in self.groups)

    def draw(self, noise: Tensor) -> Tensor:
        """The controls that standard normal numbers stand for: one for each dimension, then those that groups add."""
        draws, first = [], self.shape[-1]
        for dimensions, emission in self.groups:
            last = first + emission.noise - len(dimensions)
            draws.append(emission.draw(noise[..., [*dimensions, *range(first, last)]]))
            first = last
        return self._joined(draws)

    def divergence(self, i: int) -> Tensor:
        """The sum of the groups' divergences."""
        return reduce(add, (emission.divergence(i) for _, emission in self.groups))

    def steps(self) -> list[Self]:
        """One for each step."""
        each = zip(*(emission.steps() for _, emission in self.groups), strict=True)
        names = [dimensions for dimensions, _ in self.groups]
        return [replace(self, groups=tuple(zip(names, emissions, strict=True))) for emissions in each]

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The groups of changed tensors."""
        return replace(self, groups=tuple((dimensions, emission.map(change)) for dimensions, emission in self.groups))

    def _joined(self, values: Sequence[Tensor]) -> Tensor:
        """The groups' values [..., K, A_g] in the order of the dimensions."""
        order = torch.tensor([dimension for dimensions, _ in self.groups for dimension in dimensions]).argsort()
        return torch.cat(list(values), dim=-1)[..., order]


TAIL = -30.0
"""Below, log Φ is computed by its asymptotic series: erfc ends at -37."""


def log_ndtr(values: Tensor) -> Tensor:
    """log Φ(x) in float64, with a gradient that is finite however small x is.

    torch's own takes ten times as long, gives NaN in float32, and loses its gradient to rounding from -1e8 on.
    """
    x = values.double()
    within = (0.5 * torch.erfc(x.clamp(min=TAIL) * -math.sqrt(0.5))).log()
    if not bool((x < TAIL).any()):
        return within
    tail = x.clamp(max=TAIL)
    r = tail.square().reciprocal()
    series = -0.5 * tail.square() - (-tail).log() - 0.5 * LOG_2PI + (-r * (1 - 3 * r * (1 - 5 * r))).log1p()
    return torch.where(x < TAIL, series, within)
