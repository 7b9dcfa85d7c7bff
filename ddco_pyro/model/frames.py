"""Pictures of several trajectories as networks see them, read on demand, or held on the networks' device."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.pictures import Job, Observed, Pictures, Readers, Transform, shift_into


@dataclass(frozen=True, eq=False)
class Frames(Mapping[str, Tensor]):
    """Pictures of N trajectories by observation, each uint8 [N, T, H, W, C], zeros past their ends.

    :param arrays: of each observation the pictures [T_n, ...] of each trajectory, in memory or in their file.
    :param transforms: how they are cropped and scaled.
    :param rows: the numbers of the trajectories in the batch that these are a part of.
    :param steps: the T steps of time.
    :param shifts: rows and columns by which the pictures of each trajectory are shifted, [N, 2]; by default none.
    :param readers: read files, with prefetching or without, or hold the pictures on a device.
    """

    arrays: Mapping[str, tuple[Observed, ...]]
    transforms: Mapping[str, Transform]
    rows: tuple[int, ...]
    steps: slice
    shifts: Mapping[str, np.ndarray] = field(default_factory=dict)
    readers: Readers | DeviceFrames = field(default_factory=lambda: Readers(0))

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
        """The job of reading them."""
        return Job(self.rows, self.arrays, self.steps, self.transforms, self.shifts)

    @property
    def stored(self) -> bool:
        """Whether all of them are in files."""
        return all(isinstance(array, Pictures) for arrays in self.arrays.values() for array in arrays)

    @property
    def size(self) -> int:
        """Bytes of the pictures as networks see them, without padding."""
        return sum(
            len(array) * math.prod(self.transforms[key].shape(array.shape[1:]))
            for key, arrays in self.arrays.items()
            for array in arrays
        )

    def held(self, device: torch.device) -> Frames:
        """These frames on a device; the pictures are read once, one trajectory at a time.

        :raises DemonstrationsError: a file cannot be read.
        """
        return replace(self, readers=DeviceFrames(self, device))

    def loaded(self) -> dict[str, Tensor]:
        """All pictures, in memory, or on the device that holds them.

        :raises DemonstrationsError: a file cannot be read.
        """
        return {key: torch.as_tensor(array) for key, array in self.readers.take(self.job).items()}

    def part(self, rows: Tensor | slice, steps: slice) -> Frames:
        """The frames of some trajectories and of consecutive steps; nothing is read."""
        chosen = torch.arange(len(self.rows))[rows].tolist()
        arrays = {key: tuple(each[row] for row in chosen) for key, each in self.arrays.items()}
        shifts = {key: each[chosen] for key, each in self.shifts.items()}
        first, last, _ = steps.indices(self.batch[1])
        seen = slice(self.steps.start + first, self.steps.start + last)
        return replace(self, arrays=arrays, shifts=shifts, rows=tuple(self.rows[row] for row in chosen), steps=seen)


class DeviceFrames:
    """Preprocessed pictures of trajectories on a device, in place of :class:`Readers`."""

    def __init__(self, frames: Frames, device: torch.device) -> None:
        self._pictures = {
            (key, row): _whole(array, frames.transforms[key]).to(device)
            for key, arrays in frames.arrays.items()
            for row, array in zip(frames.rows, arrays, strict=True)
        }

    def plan(self, _: Iterable[Job]) -> None:
        """Nothing: all pictures are there."""

    def take(self, job: Job) -> dict[str, Tensor]:
        """The pictures of a job, on the device."""
        return {key: self._padded(key, job) for key in job.arrays}

    def _padded(self, key: str, job: Job) -> Tensor:
        """:func:`ddco_pyro.data.pictures.padded` of pictures that are on the device as networks see them."""
        pictures, shifts = [self._pictures[key, row] for row in job.rows], job.shifts.get(key)
        whole = pictures[0].new_zeros(len(pictures), job.steps.stop - job.steps.start, *pictures[0].shape[1:])
        for row, each in enumerate(pictures):
            seen = each[job.steps]
            shift_into(whole[row, : len(seen)], seen, *((0, 0) if shifts is None else shifts[row].tolist()))
        return whole


def _whole(array: Observed, transform: Transform) -> Tensor:
    return torch.from_numpy(np.concatenate(list(transform.seen(array, slice(0, len(array))))))
