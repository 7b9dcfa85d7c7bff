"""Cameras of a task, drawn only where a spec observes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import dm_env
import numpy as np
from dm_env import specs


@dataclass(frozen=True)
class Camera:
    """An observation that is a picture.

    :param size: height and width, pixels.
    :param draw: a picture of the environment's current state, uint8 [height, width, 3].
    """

    size: tuple[int, int]
    draw: Callable[[dm_env.Environment], np.ndarray]

    digest = ""
    """Identity of a picture beyond its task's sources: none."""

    def spec(self, name: str) -> specs.Array:
        """The spec of the observation."""
        return specs.BoundedArray((*self.size, 3), np.uint8, 0, 255, name)


@dataclass(frozen=True)
class Encoded:
    """An observation that is an encoder's features of a camera's picture.

    :param encoder: uint8 [height, width, 3] to float32 [features], such as those of
        :func:`ddco_pyro.encoding.load`. An optional attribute ``digest`` identifies what the task's sources
        do not hold, such as weights.
    """

    camera: Camera
    encoder: Callable[[np.ndarray], np.ndarray]
    features: int

    @property
    def digest(self) -> str:
        """Identity of the features beyond the task's sources."""
        return str(getattr(self.encoder, "digest", ""))

    def draw(self, environment: dm_env.Environment) -> np.ndarray:
        """The features of a picture of the environment's current state, float32 [features]."""
        return self.encoder(self.camera.draw(environment))

    def spec(self, name: str) -> specs.Array:
        """The spec of the observation."""
        return specs.Array((self.features,), np.float32, name)


@dm_env.Environment.register
class Watched:
    """A dm_env environment with the pictures of ``cameras`` as further observations."""

    def __init__(self, environment: dm_env.Environment, cameras: Mapping[str, Camera | Encoded]) -> None:
        self._environment, self._cameras = environment, dict(cameras)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._environment, name)

    def reset(self) -> dm_env.TimeStep:
        return self._seen(self._environment.reset())

    def step(self, action: Any) -> dm_env.TimeStep:
        return self._seen(self._environment.step(action))

    def _seen(self, step: dm_env.TimeStep) -> dm_env.TimeStep:
        pictures = {name: camera.draw(self._environment) for name, camera in self._cameras.items()}
        return step._replace(observation={**step.observation, **pictures})

    def observation_spec(self) -> dict[str, specs.Array]:
        pictures = {name: camera.spec(name) for name, camera in self._cameras.items()}
        return {**self._environment.observation_spec(), **pictures}
