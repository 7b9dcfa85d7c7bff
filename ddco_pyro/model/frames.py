"""Pictures of several trajectories as networks see them, read when a network asks for them, or held on its device."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.pictures import Job, Observed, Pictures, Readers, Transform


@dataclass(frozen=True, eq=False)
class Frames(Mapping[str, Tensor]):
    """Pictures of N trajectories by observation, each uint8 [N, T, H, W, C], zeros past their ends.

    :param arrays: of each observation the pictures [T_n, ...] of each trajectory, in memory or in their file.
    :param transforms: what is seen of them.
    :param rows: what the trajectories are called among those that this is a part of.
    :param steps: the steps of time that are seen, T of them.
    :param shifts: by how many rows and columns the pictures of each trajectory are moved, [N, 2]; none where left out.
    :param readers: read what is in files, perhaps before it is asked for, or hold all of it on a device.
    """

    arrays: Mapping[str, tuple[Observed, ...]]
    transforms: Mapping[str, Transform]
    rows: tuple[int, ...]
    steps: slice
    shifts: Mapping[str, np.ndarray] = field(default_factory=dict)
    readers: Readers | Held = field(default_factory=lambda: Readers(0))

    def __getitem__(self, key: str) -> Tensor:
        return replace(self, arrays={key: self.arrays[key]}).loaded()[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return len(self.arrays)

    @property
    def batch(self) -> tuple[int, int]:
        """(N, T)."""
        return len(self.rows), self.steps.stop - self.steps.start

    @property
    def job(self) -> Job:
        """What is to be read for them."""
        return Job(self.rows, self.arrays, self.steps, self.transforms, self.shifts)

    @property
    def stored(self) -> bool:
        """Whether all of them are in files."""
        return all(isinstance(array, Pictures) for arrays in self.arrays.values() for array in arrays)

    @property
    def size(self) -> int:
        """Bytes of the trajectories' pictures as they are seen, without padding."""
        return sum(
            len(array) * math.prod(self.transforms[key].shape(array.shape[1:]))
            for key, arrays in self.arrays.items()
            for array in arrays
        )

    def held(self, device: torch.device) -> Frames:
        """The same with all pictures on a device; they are read once, one trajectory at a time.

        :raises DemonstrationsError: a file cannot be read.
        """
        return replace(self, readers=Held(self, device))

    def loaded(self) -> dict[str, Tensor]:
        """All of them, in memory, or on the device that holds them.

        :raises DemonstrationsError: a file cannot be read.
        """
        return {key: torch.as_tensor(array) for key, array in self.readers.take(self.job).items()}

    def part(self, rows: Tensor | slice, steps: slice) -> Frames:
        """The same of some trajectories and of consecutive steps; nothing is read."""
        chosen = torch.arange(len(self.rows))[rows].tolist()
        arrays = {key: tuple(each[row] for row in chosen) for key, each in self.arrays.items()}
        shifts = {key: each[chosen] for key, each in self.shifts.items()}
        first, last, _ = steps.indices(self.batch[1])
        seen = slice(self.steps.start + first, self.steps.start + last)
        return replace(self, arrays=arrays, shifts=shifts, rows=tuple(self.rows[row] for row in chosen), steps=seen)


class Held:
    """Has the pictures of trajectories on a device, as they are seen, and gives what :class:`Readers` would read."""

    def __init__(self, frames: Frames, device: torch.device) -> None:
        self._pictures = {
            (key, row): _whole(array, frames.transforms[key]).to(device)
            for key, arrays in frames.arrays.items()
            for row, array in zip(frames.rows, arrays, strict=True)
        }

    def plan(self, _: Iterable[Job]) -> None:
        """Nothing is read any more."""

    def take(self, job: Job) -> dict[str, Tensor]:
        """The pictures of a job, on the device."""
        return {
            key: _padded([self._pictures[key, row] for row in job.rows], job.steps, job.shifts.get(key))
            for key in job.arrays
        }


def _whole(array: Observed, transform: Transform) -> Tensor:
    return torch.from_numpy(np.concatenate(list(transform.seen(array, slice(0, len(array))))))


def _padded(pictures: Sequence[Tensor], steps: slice, shifts: np.ndarray | None) -> Tensor:
    """:func:`ddco_pyro.data.pictures.padded` of pictures on a device, which are as they are seen."""
    whole = pictures[0].new_zeros(len(pictures), steps.stop - steps.start, *pictures[0].shape[1:])
    for row, each in enumerate(pictures):
        seen = each[steps]
        whole[row, : len(seen)] = seen if shifts is None else _shifted(seen, *shifts[row].tolist())
    return whole


def _shifted(pictures: Tensor, down: int, right: int) -> Tensor:
    """:func:`ddco_pyro.data.pictures.shifted` on a device."""
    for axis, by in ((1, down), (2, right)):
        last = pictures.shape[axis] - 1
        from_ = (torch.arange(last + 1, device=pictures.device) - by).clamp(0, last)
        pictures = pictures.index_select(axis, from_)
    return pictures
