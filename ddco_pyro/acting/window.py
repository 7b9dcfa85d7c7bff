"""Network inputs from observations that arrive one at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from ddco_pyro.errors import BadInput
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.networks import Inputs


class ObservationError(BadInput):
    """An observation that is missing, or of another shape than in the demonstrations."""


class Window:
    """A window over the last observations, for the encoder's differences and stacked pictures.

    ``time`` counts the observations.
    """

    def __init__(self, encoder: ObservationEncoder) -> None:
        self.encoder, self.time = encoder, 0
        self._last: deque[list[dict[str, np.ndarray]]] = deque(maxlen=encoder.steps_seen)

    def inputs(self, observations: Sequence[Mapping[str, np.ndarray]]) -> Inputs:
        """The networks' inputs for an observation of each of N episodes, T = 1.

        :raises ObservationError: an observation is missing, has another shape than in training, or is not finite.
        """
        now = [
            {key: self._checked(observation, key, shape) for key, shape in self.encoder.shapes.items()}
            for observation in observations
        ]
        self._last.append(now)
        episodes = zip(*self._last, strict=True)
        recent = self.encoder.inputs(
            ({key: np.stack([seen[key] for seen in episode]) for key in self.encoder.shapes} for episode in episodes),
            np.full(len(self._last), self.time),
        )
        latest = recent.part(slice(None), slice(-1, None)).loaded()
        inputs = Inputs(latest.vectors, latest.images, torch.tensor([self.time]))
        self.time += 1
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
