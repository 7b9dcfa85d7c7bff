"""The inputs of networks: pictures read on demand, vectors, and their shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.pictures import Transform, padded
from ddco_pyro.errors import nearest


@dataclass(frozen=True, eq=False)
class Frames(Mapping[str, Tensor]):
    """Pictures of N trajectories by observation, each uint8 [N, T, H, W, C], zeros past their ends.

    :param arrays: of each observation the pictures [T_n, ...] of each trajectory, in memory or in their file.
    :param transforms: how they are cropped and scaled.
    :param steps: the T steps of time.
    :param shifts: rows and columns by which the pictures of each trajectory are shifted, [N, 2]; by default none.
    """

    arrays: Mapping[str, tuple[Observed, ...]]
    transforms: Mapping[str, Transform]
    steps: slice
    shifts: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __getitem__(self, key: str) -> Tensor:
        return torch.from_numpy(padded(self.arrays[key], self.steps, self.transforms[key], self.shifts.get(key)))

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return len(self.arrays)

    @property
    def batch(self) -> tuple[int, int]:
        """(N, T)."""
        return len(next(iter(self.arrays.values()))), self.steps.stop - self.steps.start

    def part(self, rows: Tensor | slice, steps: slice) -> Frames:
        """The frames of some trajectories and of consecutive steps; nothing is read."""
        chosen = torch.arange(self.batch[0])[rows].tolist()
        arrays = {key: tuple(each[row] for row in chosen) for key, each in self.arrays.items()}
        shifts = {key: each[chosen] for key, each in self.shifts.items()}
        first, last, _ = steps.indices(self.batch[1])
        seen = slice(self.steps.start + first, self.steps.start + last)
        return replace(self, arrays=arrays, shifts=shifts, steps=seen)


T = TypeVar("T")


class ShapeError(ValueError):
    """A network cannot read its observations, lacks an option, or gives outputs of a wrong shape."""


@dataclass(frozen=True)
class InputShape:
    """Shapes of :class:`Inputs` without the batch, by name in the spec's order.

    :param vectors: the number of features of each vector observation.
    :param images: [H, W, C] of each picture.
    :param steps: of the longest demonstration.
    """

    vectors: Mapping[str, int]
    images: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    steps: int = 1

    @property
    def vector(self) -> int:
        """Features of all vectors together."""
        return sum(self.vectors.values())

    def select(self, names: Sequence[str]) -> InputShape:
        """The shapes of these observations alone, in this order.

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
    """Observations of N trajectories by name.

    :param vectors: float32 [N, T, F_key].
    :param images: uint8 [N, T, H, W, C]; in a batch perhaps :class:`Frames`, for a network tensors.
    :param time: the number of each step, [T].
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
        """These observations alone, in this order; nothing is read."""
        if isinstance(self.images, Frames):
            images: Mapping[str, Tensor] = replace(self.images, arrays=_of(self.images.arrays, names))
        else:
            images = _of(self.images, names)
        return Inputs(_of(self.vectors, names), images, self.time)

    def chunks(self, steps: int) -> Iterator[Inputs]:
        """Consecutive parts of at most ``steps`` steps, and of at least one."""
        size = max(steps, 1)
        for first in range(0, self.batch[1], size):
            yield self.part(slice(None), slice(first, first + size))

    def part(self, rows: Tensor | slice, steps: slice) -> Inputs:
        """Consecutive steps of some trajectories."""
        vectors = {key: array[rows, steps] for key, array in self.vectors.items()}
        if isinstance(self.images, Frames):
            return Inputs(vectors, self.images.part(rows, steps), self.time[steps])
        return Inputs(vectors, {key: array[rows, steps] for key, array in self.images.items()}, self.time[steps])

    def loaded(self) -> Inputs:
        """These inputs with all images in memory.

        :raises DemonstrationsError: a file cannot be read.
        """
        return Inputs(self.vectors, dict(self.images), self.time) if isinstance(self.images, Frames) else self

    def to(self, device: torch.device) -> Inputs:
        """These inputs on a device; images have to be in memory."""
        if self.time.device == device:
            return self
        return self.map(lambda array: array.to(device), self.time.to(device))

    def map(self, change: Callable[[Tensor], Tensor], time: Tensor) -> Inputs:
        """Inputs of changed arrays, at other times."""
        vectors, images = (
            {key: change(array) for key, array in arrays.items()} for arrays in (self.vectors, self.images)
        )
        return Inputs(vectors, images, time)


def _of(values: Mapping[str, T], names: Sequence[str]) -> dict[str, T]:
    return {name: values[name] for name in names if name in values}
