"""Observations as they come in, one at a time, to what the networks see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ddco_pyro.errors import BadInput
from ddco_pyro.model.encoding import ObservationEncoder
from ddco_pyro.model.networks import Inputs


class ObservationError(BadInput):
    """An observation that is missing, or has another shape than the demonstrations had."""


class Window:
    """The last observations are remembered for the encoder's differences; ``time`` counts the observations seen."""

    def __init__(self, encoder: ObservationEncoder) -> None:
        self.encoder, self.time = encoder, 0
        self._last: Sequence[dict[str, np.ndarray]] | None = None

    def inputs(self, observations: Sequence[Mapping[str, np.ndarray]]) -> Inputs:
        """The networks' inputs for an observation of each of N episodes, T = 1.

        :raises ObservationError: an observation is missing, has an unseen shape, or is not finite.
        """
        now = [
            {key: self._checked(observation, key, shape) for key, shape in self.encoder.shapes.items()}
            for observation in observations
        ]
        pairs = zip(self._last or now, now, strict=True)
        both = self.encoder.inputs(
            ({key: np.stack([old[key], new[key]]) for key in new} for old, new in pairs),
            np.array([self.time, self.time]),
        )
        latest = both.part(slice(None), slice(1, 2)).loaded()
        inputs = Inputs(latest.vectors, latest.images, torch.tensor([self.time]))
        self._last, self.time = now, self.time + 1
        return inputs

    def _checked(self, observation: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
        if key not in observation:
            known = ", ".join(sorted(observation))
            raise ObservationError(f"the observation has no {key!r} (it has: {known})")
        value = np.asarray(observation[key])
        if value.shape != tuple(shape):
            raise ObservationError(
                f"observation {key!r} has shape {value.shape}, the demonstrations had {tuple(shape)}"
            )
        if value.dtype.kind not in "fiub" or (key in self.encoder.images and value.dtype != np.uint8):
            needed = "uint8" if key in self.encoder.images else "numbers"
            raise ObservationError(f"observation {key!r} is {value.dtype}, it has to be {needed}")
        if not np.isfinite(value).all():
            raise ObservationError(f"observation {key!r} is not finite")
        return value
