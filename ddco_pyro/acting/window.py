"""Network inputs from observations that arrive one at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ddco_pyro.data.checks import NUMBERS, usable
from ddco_pyro.data.controls import number
from ddco_pyro.errors import BadInput
from ddco_pyro.model.batch import LARGEST_SCALED
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.model.networks import Inputs


class ObservationError(BadInput):
    """An observation that is missing, or of another shape than in the demonstrations."""


class Window:
    """A window over the last observations, for what the encoder makes of several.

    ``time`` counts the observations.
    """

    def __init__(self, encoder: ObservationEncoder) -> None:
        self.encoder, self.time = encoder, 0
        self._last: list[list[dict[str, np.ndarray]]] = []

    def inputs(self, observations: Sequence[Mapping[str, np.ndarray]]) -> Inputs:
        """The networks' inputs for an observation of each of N episodes, T = 1.

        :raises ObservationError: an observation is missing, has another shape than in training, is not finite, or too
            large for networks.
        """
        now = [
            {key: self._checked(observation, key, shape) for key, shape in self.encoder.shapes.items()}
            for observation in observations
        ]
        if not now:
            raise ObservationError("there are no observations; give one for each episode")
        last = [*self._last, now][-2:]  # differences are from the step before
        episodes = zip(*last, strict=True)
        recent = self.encoder.inputs(
            ({key: np.stack([seen[key] for seen in episode]) for key in self.encoder.shapes} for episode in episodes),
            np.full(len(last), self.time),
        )
        latest = recent.part(slice(None), slice(-1, None)).loaded()
        inputs = Inputs(latest.vectors, latest.images, torch.tensor([self.time]))
        for key, vector in latest.vectors.items():
            refuse_large(f"observation {key!r}", vector.numpy())
        self._last, self.time = last, self.time + 1
        return inputs

    def _checked(self, observation: Mapping[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
        if not isinstance(observation, Mapping):
            given = type(observation).__name__
            raise ObservationError(f"an observation has to be a mapping, such as {{{key!r}: array}}; got {given}")
        if key not in observation:
            known = ", ".join(sorted(map(str, observation)))
            raise ObservationError(f"the observation has no {key!r} (it has: {known})")
        value = numbers(f"observation {key!r}", observation[key], tuple(shape))
        if key in self.encoder.images and value.dtype != np.uint8:
            raise ObservationError(f"observation {key!r} is {value.dtype}, it has to be uint8")
        return value


def numbers(what: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An array of finite real numbers.

    :param what: the name of the value in errors.
    :raises ObservationError: the value is something else, or has another shape.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ObservationError(f"{what} is no array: {' '.join(str(error).split())}") from None
    if array.shape != shape:
        raise ObservationError(f"{what} has shape {array.shape}, the demonstrations had {shape}")
    if array.dtype.kind not in NUMBERS:
        raise ObservationError(f"{what} is {array.dtype}, it has to be numbers")
    if not usable(array).all():
        raise ObservationError(f"{what} is {'too large' if np.isfinite(array).all() else 'not finite'}")
    return array


def refuse_large(what: str, scaled: np.ndarray) -> None:
    """Refuse numbers in scaled units that are too large for networks.

    :raises ObservationError: one of them is.
    """
    largest = np.abs(scaled).max(initial=0.0)
    if largest > LARGEST_SCALED:
        raise ObservationError(
            f"{what} is {number(float(f'{largest:.2g}'))} once it is scaled, and networks take at most "
            f"{LARGEST_SCALED:g}; is it in the demonstrations' units?"
        )
