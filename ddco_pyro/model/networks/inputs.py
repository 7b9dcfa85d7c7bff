"""The inputs of networks: pictures read on demand, vectors, and their shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.pictures import Transform, padded
from ddco_pyro.errors import nearest
from ddco_pyro.model.tables import by_step, by_trajectory, part


@dataclass(frozen=True, eq=False)
class Frames:
    """Pictures of N trajectories that are read when asked for, uint8 [N, T, H, W, C], zeros past their ends.

    :param arrays: the pictures [T_n, ...] of each trajectory, in memory or in their file.
    :param transform: how they are cropped and scaled.
    :param steps: the T steps of time.
    :param shifts: rows and columns by which each trajectory's pictures are shifted, [N, 2]; or None.
    """

    arrays: tuple[Observed, ...]
    transform: Transform
    steps: slice
    shifts: np.ndarray | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(N, T)."""
        return len(self.arrays), self.steps.stop - self.steps.start

    def __getitem__(self, part: tuple[Tensor | slice, slice]) -> Frames:
        """The frames of some trajectories and of consecutive steps; nothing is read."""
        chosen = torch.arange(len(self.arrays))[part[0]].tolist()
        first, last, _ = part[1].indices(self.shape[1])
        return Frames(
            tuple(self.arrays[row] for row in chosen),
            self.transform,
            slice(self.steps.start + first, self.steps.start + last),
            None if self.shifts is None else self.shifts[chosen],
        )

    def read(self) -> Tensor:
        """The pictures.

        :raises DemonstrationsError: a file cannot be read.
        """
        return torch.from_numpy(padded(self.arrays, self.steps, self.transform, self.shifts))


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
                missing = f"there is no observation {name!r}{nearest(name, known)}"
                raise ShapeError(f"inputs: {missing}; there is: {there}")
        return InputShape(_of(self.vectors, names), _of(self.images, names), self.steps)


@dataclass(frozen=True)
class Inputs:
    """Observations of N trajectories by name.

    :param vectors: float32 [N, T, F_key].
    :param images: uint8 [N, T, H, W, C]; :class:`Frames` in a batch, tensors for a network (:meth:`loaded`).
    :param time: the number of each step, [T].
    """

    vectors: Mapping[str, Tensor]
    images: Mapping[str, Any]
    time: Tensor

    @property
    def batch(self) -> tuple[int, int]:
        """(N, T)."""
        array = next(iter([*self.vectors.values(), *self.images.values()]))
        return array.shape[0], array.shape[1]

    @cached_property
    def vector(self) -> Tensor:
        """All vectors side by side, [N, T, F]."""
        return self.joined([*self.vectors])

    def joined(self, names: Sequence[str]) -> Tensor:
        """These vectors side by side, [N, T, F]; F is 0 where there are none."""
        if not self.vectors:
            return torch.zeros(*self.batch, 0, device=self.time.device)
        each = [by_step(self.vectors[name]) for name in names] or [by_step(self.vector)[:0]]
        return by_trajectory(torch.cat(each) if len(each) > 1 else each[0])

    def select(self, names: Sequence[str]) -> Inputs:
        """These observations alone, in this order; nothing is read."""
        return Inputs(_of(self.vectors, names), _of(self.images, names), self.time)

    def chunks(self, steps: int) -> Iterator[Inputs]:
        """Consecutive parts of at most ``steps`` steps, and of at least one."""
        size = max(steps, 1)
        for first in range(0, self.batch[1], size):
            yield self.part(slice(None), slice(first, first + size))

    def part(self, rows: Tensor | slice, steps: slice) -> Inputs:
        """Consecutive steps of some trajectories; nothing is read."""
        vectors = {key: part(vector, rows, steps) for key, vector in self.vectors.items()}
        images = {key: image[rows, steps] for key, image in self.images.items()}
        return Inputs(vectors, images, self.time[steps])

    def loaded(self) -> Inputs:
        """These inputs with all images in memory.

        :raises DemonstrationsError: a file cannot be read.
        """
        unread = {key: image.read() for key, image in self.images.items() if isinstance(image, Frames)}
        return Inputs(self.vectors, {**self.images, **unread}, self.time) if unread else self

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
