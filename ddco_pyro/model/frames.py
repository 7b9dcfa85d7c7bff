"""Pictures of several trajectories as networks see them, read when a network asks for them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.pictures import Observed, Transform, padded


@dataclass(frozen=True, eq=False)
class Frames(Mapping[str, Tensor]):
    """Pictures of N trajectories by observation, each uint8 [N, T, H, W, C], zeros past their ends.

    :param arrays: of each observation the pictures [T_n, ...] of each trajectory, in memory or in their file.
    :param transforms: what is seen of them.
    :param steps: the steps of time that are seen, T of them.
    :param shifts: by how many rows and columns the pictures of each trajectory are moved, [N, 2]; none where left out.
    """

    arrays: Mapping[str, tuple[Observed, ...]]
    transforms: Mapping[str, Transform]
    steps: slice
    shifts: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __getitem__(self, key: str) -> Tensor:
        seen = padded(self.arrays[key], self.steps, self.transforms[key], self.shifts.get(key))
        return torch.from_numpy(seen)

    def __iter__(self) -> Iterator[str]:
        return iter(self.arrays)

    def __len__(self) -> int:
        return len(self.arrays)

    @property
    def batch(self) -> tuple[int, int]:
        """(N, T)."""
        return len(next(iter(self.arrays.values()))), self.steps.stop - self.steps.start

    def part(self, rows: Tensor | slice, steps: slice) -> Frames:
        """The same of some trajectories and of consecutive steps; nothing is read."""
        chosen = torch.arange(self.batch[0])[rows].tolist()
        arrays = {key: tuple(each[row] for row in chosen) for key, each in self.arrays.items()}
        shifts = {key: each[chosen] for key, each in self.shifts.items()}
        first, last, _ = steps.indices(self.batch[1])
        start = self.steps.start
        return replace(self, arrays=arrays, shifts=shifts, steps=slice(start + first, start + last))
