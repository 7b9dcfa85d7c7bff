"""Emissions: how the numbers that networks give a caller become a distribution of the control (paper §4.2).

The callers of a level share one emission object. Each kind of distribution is a class in a file of its own;
the package has them by name. Controls are in scaled units; log-densities are in the control's own units.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from ddco_pyro.data.controls import ControlPart
from ddco_pyro.model.tables import by_step, by_trajectory

LOG_2PI = math.log(2 * math.pi)

Part = Mapping[str, Any]
"""A part of the control as an export describes it."""


def over_dimensions(each: Tensor) -> Tensor:
    """The sum over the control's dimensions, [..., K, A] to [..., K], in the same order in memory."""
    return by_trajectory(by_step(each, each.dim() - 2).sum(1), each.dim() - 2)


def log_logistic(y: Tensor) -> Tensor:
    """log logistic(y), [..., K, A], in the same order in memory; torch's own changes it."""
    return by_trajectory(logsigmoid(by_step(y, y.dim() - 2)), y.dim() - 2)


def phi(z: float) -> float:
    """The standard normal distribution function."""
    return 0.5 * math.erfc(-z / math.sqrt(2))


@dataclass(frozen=True)
class Information:
    """The information that the posterior expects of some numbers of a network, for an M-step.

    :param columns: the numbers.
    :param weight: h of each output [N, T, K, n]. Or a weight of all outputs, [N, T, K]: h is the weight times
        1/σ².
    :param std: the places of σ of these means among the parameters of the control.
    :param count: how many controls the weight stands for, [N, T, K]; None where it is their number.
    """

    columns: slice
    weight: Tensor
    std: tuple[int, ...] = ()
    count: Tensor | None = None

    def moved(self, numbers: int, parameters: int) -> Information:
        """The same information where so many numbers and parameters come before."""
        columns = slice(self.columns.start + numbers, self.columns.stop + numbers)
        return replace(self, columns=columns, std=tuple(place + parameters for place in self.std))

    @classmethod
    def of_logits(cls, columns: slice, weight: Tensor, p: Tensor) -> Self:
        """At least that of logits of a choice with these probabilities, [N, T, K, n], made with a weight [N,
        T, K].

        diag(p) - pp^T is the Laplacian of a graph, and so at most twice its own diagonal.
        """
        return cls(columns, 2 * weight.unsqueeze(-1) * p * (1 - p))


class Given(NamedTuple):
    """What the distribution of a part of the control is made of.

    :param numbers: of the callers' network, [..., K, size].
    :param std: σ, [n], [K, n] or [..., K, n]; n is 0 where the part is not continuous.
    :param log_scale: logarithms of the units, [A].
    :param low: the lower bounds in scaled units, [A]; ``high`` are the upper ones.
    """

    part: ControlPart
    numbers: Tensor
    std: Tensor
    log_scale: Tensor
    low: Tensor
    high: Tensor


class Emission(ABC):
    """The distributions of the controls of K callers, [..., K, A].

    A kind is a dataclass of tensors [..., K, ...], of tensors that are the same at all steps, and of other
    emissions. The first field is a tensor [..., K, ...].

    :cvar further_noise: normal numbers that a draw takes beside one for each dimension.
    :cvar control: the control of one caller, [A] in its own units, by numpy alone: of a part, the caller's
        numbers, its parameters, and standard normal numbers, None for the mode. An export has its source.
    :cvar helpers: the functions that :attr:`control` calls.
    """

    further_noise: ClassVar[int] = 0
    helpers: ClassVar[tuple[Callable[..., Any], ...]] = ()
    control: ClassVar[Any]

    @classmethod
    def of(cls, given: Given) -> Self:
        """The distribution of a part of the control: by default of the network's numbers alone."""
        return cls(given.numbers)  # type: ignore[call-arg]

    @classmethod
    def size(cls, part: ControlPart) -> int:
        """How many numbers a network gives a caller: A, unless a kind says otherwise."""
        return len(part.dims)

    @classmethod
    def possible(cls, part: ControlPart, scaled: np.ndarray) -> np.ndarray:
        """Which controls [T, A] have a probability above 0, [T, A] or [T, 1]."""
        return np.ones((len(scaled), 1), dtype=bool)

    @property
    def shape(self) -> torch.Size:
        """[..., K, A]: that of the first field, unless a kind says otherwise."""
        first: Tensor = next(iter(self._fields().values()))
        return first.shape

    @property
    def noise(self) -> int:
        """How many standard normal numbers a control is drawn from."""
        return self.shape[-1] + self.further_noise

    @property
    def numbers(self) -> int:
        """How many numbers of a network the distribution has: those of the first field, by default."""
        return next(iter(self._fields().values())).shape[-1]  # type: ignore[no-any-return]

    @property
    def parameters(self) -> int:
        """How many parameters the distribution has."""
        return 0

    @abstractmethod
    def by_dimension(self, actions: Tensor) -> Tensor:
        """log π(a_d | s) of each caller and dimension of controls [..., A], [..., K, A]."""

    def log_density(self, actions: Tensor) -> Tensor:
        """log π(a | s) [..., K]: dimensions are independent given the caller, by default."""
        return over_dimensions(self.by_dimension(actions))

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

    @abstractmethod
    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """What the posterior expects to learn of numbers and parameters from controls [N, T, A], for an
        M-step.

        :param acting: the posterior probability that a caller acts, float64 [N, T, K].
        """

    def steps(self) -> list[Self]:
        """One emission for each step: tensors with the first field's dimensions differ between steps."""
        each = self._fields()
        dimensions = next(iter(each.values())).dim()
        varying = {
            name: value.unbind(1) if isinstance(value, Tensor) else value.steps()
            for name, value in each.items()
            if isinstance(value, Emission) or value.dim() == dimensions
        }
        steps = (dict(zip(varying, now, strict=True)) for now in zip(*varying.values(), strict=True))
        return [replace(self, **step) for step in steps]  # type: ignore[type-var]

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The emission of changed tensors."""
        changed = {
            name: change(value) if isinstance(value, Tensor) else value.map(change)
            for name, value in self._fields().items()
        }
        return replace(self, **changed)  # type: ignore[type-var]

    def _fields(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]
