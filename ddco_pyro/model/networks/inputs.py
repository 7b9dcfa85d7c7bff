"""What a network sees, and the shapes it is built for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import torch
from torch import Tensor

from ddco_pyro.errors import nearest
from ddco_pyro.model.frames import Frames

T = TypeVar("T")


class ShapeError(ValueError):
    """A network cannot read the observations it was given, lacks an option, or gives another shape than it has to."""


@dataclass(frozen=True)
class InputShape:
    """Shapes of :class:`Inputs` without the batch: ``vectors`` has the features of each vector observation, ``images``
    [H, W, C] of each picture, both by name in the spec's order; ``steps`` is the longest demonstration.
    """

    vectors: Mapping[str, int]
    images: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    steps: int = 1

    @property
    def vector(self) -> int:
        """Features of all vectors together."""
        return sum(self.vectors.values())

    def select(self, names: Sequence[str]) -> InputShape:
        """The same of these observations alone, in this order.

        :raises ShapeError: there is no such observation.
        """
        known = [*self.vectors, *self.images]
        for name in names:
            if name not in known:
                there = ", ".join(known)
                raise ShapeError(f"inputs: there is no observation {name!r}{nearest(name, known)}; there is: {there}")
        return InputShape(_of(self.vectors, names), _of(self.images, names), self.steps)


@dataclass(frozen=True)
class Inputs:
    """Observations of N trajectories by name: ``vectors`` float32 [N, T, F_key]; ``images`` uint8 [N, T, H, W, C];
    ``time`` [T] counts steps. Images may be :class:`~ddco_pyro.model.frames.Frames`; networks are given tensors.
    """

    vectors: Mapping[str, Tensor]
    images: Mapping[str, Tensor]
    time: Tensor

    @property
    def batch(self) -> tuple[int, int]:
        """(N, T)."""
        if not self.vectors and isinstance(self.images, Frames):
            return self.images.batch
        array = next(iter([*self.vectors.values()] or [*self.images.values()]))
        return array.shape[0], array.shape[1]

    @cached_property
    def vector(self) -> Tensor:
        """All vectors side by side, [N, T, F]."""
        vectors = list(self.vectors.values())
        if len(vectors) == 1:
            return vectors[0]
        return torch.cat(vectors, -1) if vectors else torch.zeros(*self.batch, 0, device=self.time.device)

    def select(self, names: Sequence[str]) -> Inputs:
        """These observations alone, in this order."""
        return Inputs(_of(self.vectors, names), _of(self.images, names), self.time)

    def chunks(self, steps: int) -> Iterator[Inputs]:
        """Consecutive parts of at most so many steps of time each, one step at least."""
        size = max(steps, 1)
        for first in range(0, self.batch[1], size):
            yield self.part(slice(None), slice(first, first + size))

    def part(self, rows: Tensor | slice, steps: slice) -> Inputs:
        """Some trajectories alone, and consecutive steps of them."""
        vectors = {key: array[rows, steps] for key, array in self.vectors.items()}
        if isinstance(self.images, Frames):
            return Inputs(vectors, self.images.part(rows, steps), self.time[steps])
        return Inputs(vectors, {key: array[rows, steps] for key, array in self.images.items()}, self.time[steps])

    def loaded(self) -> Inputs:
        """The same with all images in memory.

        :raises DemonstrationsError: a file cannot be read.
        """
        return Inputs(self.vectors, self.images.loaded(), self.time) if isinstance(self.images, Frames) else self

    def to(self, device: torch.device) -> Inputs:
        """The same on a device; images, which have to be in memory, go there as they are, uint8."""
        if self.time.device == device:
            return self
        return self.map(lambda array: array.to(device), self.time.to(device))

    def map(self, change: Callable[[Tensor], Tensor], time: Tensor) -> Inputs:
        """The same of changed arrays, at other times."""
        vectors, images = (
            {key: change(array) for key, array in arrays.items()} for arrays in (self.vectors, self.images)
        )
        return Inputs(vectors, images, time)


def _of(values: Mapping[str, T], names: Sequence[str]) -> dict[str, T]:
    return {name: values[name] for name in names if name in values}
