"""Groups of control dimensions, each of one kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Self

import torch
from torch import Tensor

from ddco_pyro.model.emissions.base import Emission, Information


@dataclass(frozen=True)
class Product(Emission):
    """Groups of control dimensions with a kind each, independent given the caller.

    :param groups: the dimensions of each group, and their emission.
    """

    groups: tuple[tuple[tuple[int, ...], Emission], ...]

    def information(self, acting: Tensor, actions: Tensor) -> Iterator[Information]:
        """That of the groups, whose numbers and parameters stand side by side."""
        numbers, parameters = 0, 0
        for dimensions, emission in self.groups:
            for own in emission.information(acting, actions[..., dimensions]):
                yield own.moved(numbers, parameters)
            numbers, parameters = numbers + emission.numbers, parameters + emission.parameters

    @property
    def shape(self) -> torch.Size:
        size = sum(len(dimensions) for dimensions, _ in self.groups)
        return torch.Size([*self.groups[0][1].shape[:-1], size])

    def by_dimension(self, actions: Tensor) -> Tensor:
        return self._joined([emission.by_dimension(actions[..., dims]) for dims, emission in self.groups])

    def log_density(self, actions: Tensor) -> Tensor:
        return reduce(add, (emission.log_density(actions[..., dims]) for dims, emission in self.groups))

    @property
    def mode(self) -> Tensor:
        return self._joined([emission.mode for _, emission in self.groups])

    @property
    def noise(self) -> int:
        return sum(emission.noise for _, emission in self.groups)

    def draw(self, noise: Tensor) -> Tensor:
        """The controls of standard normal numbers: one for each dimension, then those that groups add."""
        draws, first = [], self.shape[-1]
        for dimensions, emission in self.groups:
            last = first + emission.noise - len(dimensions)
            draws.append(emission.draw(noise[..., [*dimensions, *range(first, last)]]))
            first = last
        return self._joined(draws)

    def divergence(self, i: int) -> Tensor:
        return reduce(add, (emission.divergence(i) for _, emission in self.groups))

    def steps(self) -> list[Self]:
        each = zip(*(emission.steps() for _, emission in self.groups), strict=True)
        names = [dimensions for dimensions, _ in self.groups]
        return [replace(self, groups=tuple(zip(names, emissions, strict=True))) for emissions in each]

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        return replace(
            self, groups=tuple((dimensions, emission.map(change)) for dimensions, emission in self.groups)
        )

    def _joined(self, values: Sequence[Tensor]) -> Tensor:
        """The groups' values [..., K, A_g] in the order of the dimensions."""
        order = torch.tensor(
            [dimension for dimensions, _ in self.groups for dimension in dimensions]
        ).argsort()
        return torch.cat(list(values), dim=-1)[..., order]
