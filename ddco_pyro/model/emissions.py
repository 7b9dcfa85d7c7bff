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
from torch.nn.functional import logsigmoid, one_hot, pad
from torch.special import ndtr

from ddco_pyro.model.links import weighted_squares
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


class Kind:
    """What all kinds share: tensors as fields, of which those over time are the first ones."""

    over_time: ClassVar[int] = 1
    """Number of fields of shape [N, T, K, ...]; the others are the same at every step."""

    @property
    def numbers(self) -> Tensor:
        """What the network gave for each caller, [..., K, size]."""
        numbers: Tensor = getattr(self, fields(self)[0].name)  # type: ignore[arg-type]
        return numbers

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

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return self.mean.shape

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

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return self.mean.shape

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
        """log π(a | s), float64 [..., K]."""
        return self.by_dimension(actions).sum(-1)

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
class Binary(Kind):
    """Switches, each of them on (1) with probability logistic(y), off (0) otherwise.

    :param logits: y, [..., K, A].
    """

    logits: Tensor

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]."""
        return self.logits.shape

    def by_dimension(self, actions: Tensor) -> Tensor:
        """Logarithms of the probabilities of the switches' positions, [..., K, A]; -inf for anything but 0 and 1."""
        actions = actions.unsqueeze(-2)
        position = logsigmoid(torch.where(actions > 0.5, self.logits, -self.logits))
        return torch.where((actions == 0) | (actions == 1), position, NEVER)

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s), [..., K]."""
        return self.by_dimension(actions).sum(-1)

    @property
    def mode(self) -> Tensor:
        """The more likely position."""
        return (self.logits > 0).to(self.logits.dtype)

    def draw(self, noise: Tensor) -> Tensor:
        """On where Φ(z) is less than the probability of it."""
        return (ndtr(noise).unsqueeze(-2) < self.logits.sigmoid()).to(self.logits.dtype)

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences, ½ Σ (p_i - p_j)(y_i - y_j)."""
        first, second = self.logits[..., i, :].double(), self.logits[..., j, :].double()
        return 0.5 * ((first.sigmoid() - second.sigmoid()) * (first - second)).sum(-1)


@dataclass(frozen=True)
class Categorical(Kind):
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
        classes = self.logits.shape[-1]
        index = actions.argmax(-1, keepdim=True) if bool(self.rows) else actions.clamp(0, classes - 1).long()
        meant = one_hot(index.squeeze(-1), classes) if bool(self.rows) else index
        possible = (actions == meant).all(-1, keepdim=True).unsqueeze(-2)
        log_probs = self.logits.log_softmax(-1)
        chosen = log_probs.gather(-1, index.unsqueeze(-2).expand(*log_probs.shape[:-1], 1))
        return pad(torch.where(possible, chosen, NEVER), (0, self.shape[-1] - 1))

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

    def divergence(self, i: int, j: int) -> Tensor:
        """Mean of both divergences."""
        first, second = (self.logits[..., caller, :].double().log_softmax(-1) for caller in (i, j))
        return 0.5 * ((first.exp() - second.exp()) * (first - second)).sum(-1)

    def _action(self, index: Tensor) -> Tensor:
        actions = one_hot(index, self.logits.shape[-1]) if bool(self.rows) else index.unsqueeze(-1)
        return actions.to(self.logits.dtype)


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


def _of_caller(values: Tensor, caller: Tensor) -> Tensor:
    """Of values [..., K, E] those of one caller, [..., E]."""
    shape = torch.broadcast_shapes(values.shape[:-2], caller.shape)
    index = caller.expand(shape)[..., None, None].expand(*shape, 1, values.shape[-1])
    return values.expand(*shape, *values.shape[-2:]).gather(-2, index).squeeze(-2)
