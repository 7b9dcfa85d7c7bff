"""Gymnasium environments as dm_env environments (``pip install 'ddco-pyro[gymnasium]'``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import dm_env
import gymnasium
import numpy as np
from dm_env import specs
from gymnasium import spaces

from ddco_pyro.errors import BadInput

Observation = dict[str, np.ndarray]


class GymnasiumEnvironment(dm_env.Environment):
    """A Gymnasium environment as a dm_env environment, whose every episode starts from ``reset(seed=seed)``.

    ``gymnasium`` is the wrapped environment; ``success`` and ``total`` are the measures of the last episode.

    :raises BadInput: there is no such environment, its package is not there, or a space has another type.
    """

    def __init__(self, id: str, seed: int, options: Mapping[str, Any]) -> None:
        try:
            self.gymnasium = gymnasium.make(id, **options)
        except (gymnasium.error.Error, ImportError) as error:
            raise BadInput(f"{id}: {' '.join(str(error).split())}") from error
        self.steps = self.gymnasium.spec.max_episode_steps or 1 if self.gymnasium.spec else 1
        self._seed, self._actions = seed, self.gymnasium.action_space
        space = self.gymnasium.observation_space
        self._named = isinstance(space, spaces.Dict)
        observed = space.spaces if isinstance(space, spaces.Dict) else {"state": space}
        parts = {name: (f"{id}: observation {name!r}", each) for name, each in observed.items()}
        self._observations = {name: _spec(*part) for name, part in parts.items()}
        self._control = _spec(f"{id}: the action", self._actions)

    def reset(self) -> dm_env.TimeStep:
        observation, _ = self.gymnasium.reset(seed=self._seed)
        self.success, self.total = 0.0, 0.0
        return dm_env.restart(self._seen(observation))

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """One control step; the control [A] is clipped to the bounds of the action space."""
        control = np.clip(np.ravel(action), self._control.minimum.ravel(), self._control.maximum.ravel())
        if isinstance(self._actions, spaces.Discrete):
            given: Any = int(np.rint(control[0]))
        else:
            given = control.reshape(self._actions.shape).astype(self._actions.dtype)
        observation, reward, terminated, truncated, info = self.gymnasium.step(given)
        self.total += float(reward)
        self.success = float(info.get("is_success", terminated))
        if terminated:
            return dm_env.termination(float(reward), self._seen(observation))
        return (dm_env.truncation if truncated else dm_env.transition)(float(reward), self._seen(observation))

    def _seen(self, observation: Any) -> Observation:
        named = observation if self._named else {"state": observation}
        specs = self._observations.items()
        return {name: np.asarray(named[name]).reshape(spec.shape) for name, spec in specs}

    def observation_spec(self) -> dict[str, specs.BoundedArray]:
        return self._observations

    def action_spec(self) -> specs.BoundedArray:
        """The spec of the control [A]."""
        flat = int(np.prod(self._control.shape))
        low, high = self._control.minimum.ravel(), self._control.maximum.ravel()
        return specs.BoundedArray((flat,), self._control.dtype, low, high, "control")

    def outcome(self) -> dict[str, float]:
        """The measures of the episode that just ended."""
        return {"success": self.success, "return": self.total}

    def frame(self) -> np.ndarray:
        """The current scene, uint8 [H, W, 3].

        :raises BadInput: the environment was made without a render mode.
        """
        picture = self.gymnasium.render()
        if picture is None:
            known = "Task.from_gymnasium(..., render_mode='rgb_array')"
            raise BadInput(f"a film of a Gymnasium task needs {known}")
        return np.asarray(picture, np.uint8)

    def close(self) -> None:
        self.gymnasium.close()


def _spec(name: str, space: spaces.Space[Any]) -> specs.BoundedArray:
    """The dm_env spec of a Box, or of a Discrete space as one number."""
    if isinstance(space, spaces.Discrete):
        return specs.BoundedArray((1,), np.int64, [space.start], [space.start + space.n - 1])
    if isinstance(space, spaces.Box):
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high)
    raise BadInput(
        f"{name} is a {type(space).__name__}; a task takes Box and Discrete, or a Dict of them as observation"
    )
