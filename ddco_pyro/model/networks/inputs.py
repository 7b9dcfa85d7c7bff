"""What a network sees, and the shapes it is built for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class InputShape:
    """Shapes of :class:`Inputs` without the batch: ``vector`` features, images [H, W, C] by key, steps of time."""

    vector: int
    images: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    steps: int = 1


@dataclass(frozen=True)
class Inputs:
    """Observations of N trajectories: ``vector`` [N, T, F] float; images uint8 [N, T, H, W, C] by key; ``time`` [T]."""

    vector: Tensor
    images: Mapping[str, Tensor]
    time: Tensor

    @property
    def batch(self) -> tuple[int, int]:
        """(N, T)."""
        return self.vector.shape[0], self.vector.shape[1]


class ShapeError(ValueError):
    """A network cannot read the observations it was given, lacks an option, or gives another shape than it has to."""
