"""Pictures of several trajectories as networks see them, read when a network asks for them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.pictures import Observed, Pictures, Transform
from ddco_pyro.data.reading import Job, Readers


@dataclass(frozen=True, eq=False)
class Frames(Mapping[str, Tensor]):
    """Pictures of N trajectories by observation, each uint8 [N, T, H, W, C], zeros past their ends.

    :param arrays: of each observation the pictures [T_n, ...] of each trajectory, in memory or in their file.
    :param transforms: what is seen of them.
    :param rows: what the trajectories are called among those that this is a part of.
    :param steps: the steps of time that are seen, T of them.
    :param shifts: by how many rows and columns the pictures of each trajectory are moved, [N, 2]; none where left out.
    :param readers: read what is in files, perhaps before it is asked for.
    """

    arrays: Mapping[str, tuple[Observed, ...]]
    transforms: Mapping[str, Transform]
    rows: tuple[int, ...]
    steps: slice
    shifts: Mapping[str, np.ndarray] = field(default_factory=dict)
    readers: Readers = field(default_factory=lambda: Readers(0))

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
        key = (*self.arrays, self.rows, self.steps.start, self.steps.stop)
        return Job(key, self.arrays, self.steps, self.transforms, self.shifts)

    @property
    def stored(self) -> bool:
        """Whether all of them are in files."""
        return all(isinstance(array, Pictures) for arrays in self.arrays.values() for array in arrays)

    def loaded(self) -> dict[str, Tensor]:
        """All of them, in memory.

        :raises DemonstrationsError: a file cannot be read.
        """
        return {key: torch.from_numpy(array) for key, array in self.readers.take(self.job).items()}

    def part(self, rows: Tensor | slice, steps: slice) -> Frames:
        """The same of some trajectories and of consecutive steps; nothing is read."""
        chosen = torch.arange(len(self.rows))[rows].tolist()
        arrays = {key: tuple(each[row] for row in chosen) for key, each in self.arrays.items()}
        shifts = {key: each[chosen] for key, each in self.shifts.items()}
        first, last, _ = steps.indices(self.batch[1])
        seen = slice(self.steps.start + first, self.steps.start + last)
        return replace(self, arrays=arrays, shifts=shifts, rows=tuple(self.rows[row] for row in chosen), steps=seen)
