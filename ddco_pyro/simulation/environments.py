"""Tasks as Gymnasium environments, and the other way round (``pip install 'ddco-pyro[gymnasium]'``).

    import gymnasium
    import ddco_pyro.simulation.environments    # registers ddco/<task>-v0 for every task

    environment = gymnasium.make("ddco/needle-v0")

``gymnasium.make("ddco_pyro.simulation.environments:ddco/needle-v0")`` does both at once. The other direction is
:meth:`ddco_pyro.simulation.task.Task.from_gymnasium`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib.metadata import entry_points
from typing import Any

import dm_env
import gymnasium
import numpy as np
from dm_env import specs
from gymnasium import spaces

from ddco_pyro.errors import BadInput
from ddco_pyro.simulation.task import find_task
from ddco_pyro.spec.base import TASKS

NAMESPACE = "ddco"

Observation = dict[str, np.ndarray]


class TaskEnvironment(gymnasium.Env[Observation, np.ndarray]):
    """A task of this library as a Gymnasium environment.

    ``reset(seed=...)`` gives the initial state of the rollout with this seed. The ``info`` of the last step has the
    task's measures, such as ``success``.

    :param task: a registered name or ``module:name``; see :func:`ddco_pyro.simulation.task.find_task`.
    :param observed: the task's cameras to add to the observations.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (as Gymnasium has it)

    def __init__(self, task: str, render_mode: str | None = None, observed: Collection[str] = ()) -> None:
        self.task = find_task(task)
        self.render_mode, self._observed = render_mode, observed
        self._environment = self.task.watched(0, observed)
        shapes = self._environment.observation_spec()
        boxes: Any = spaces.Dict({name: _box(spec) for name, spec in shapes.items()})
        self.observation_space = boxes
        self.action_space = _box(self._environment.action_spec())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; without a seed from the generator of an earlier one."""
        super().reset(seed=seed)
        self._environment.close()
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        self._environment = self.task.watched(seed, self._observed)
        return _observation(self._environment.reset()), {}

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control step; an episode that ends with a discount above 0 is truncated."""
        step = self._environment.step(np.asarray(action))
        ended = step.last() and step.discount == 0
        info = self.task.measured(self._environment) if step.last() else {}
        return _observation(step), float(step.reward or 0.0), bool(ended), bool(step.last() and not ended), info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The current scene, uint8 [H, W, 3]."""
        return self.task.frame(self._environment) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self._environment.close()


def _observation(step: dm_env.TimeStep) -> Observation:
    return {name: np.array(value) for name, value in step.observation.items()}


def _box(spec: specs.Array) -> spaces.Box:
    """The space of arrays that a dm_env spec describes."""
    dtype = np.dtype(spec.dtype)
    if isinstance(spec, specs.BoundedArray):
        low, high = (np.broadcast_to(end, spec.shape).astype(dtype) for end in (spec.minimum, spec.maximum))
    elif dtype.kind in "iu":
        low, high = (np.full(spec.shape, end, dtype) for end in (np.iinfo(dtype).min, np.iinfo(dtype).max))
    else:
        low, high = np.full(spec.shape, -np.inf, dtype), np.full(spec.shape, np.inf, dtype)
    return spaces.Box(low, high, spec.shape, dtype.type)


# --- Gymnasium's as dm_env's ------------------------------------------------------------------------------------------


class GymnasiumEnvironment(dm_env.Environment):
    """A Gymnasium environment as a dm_env environment, whose every episode starts from ``reset(seed=seed)``.

    ``gymnasium`` is the wrapped environment; ``success`` and ``total`` are the measures of the last episode.

    :raises BadInput: the environment is not registered, its package cannot be imported, or a space has another type.
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
        self._observations = {name: _spec(f"{id}: observation {name!r}", each) for name, each in observed.items()}
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
        return {name: np.asarray(named[name]).reshape(spec.shape) for name, spec in self._observations.items()}

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
            raise BadInput("a film of a Gymnasium task needs Task.from_gymnasium(..., render_mode='rgb_array')")
        return np.asarray(picture, np.uint8)

    def close(self) -> None:
        self.gymnasium.close()


def _spec(name: str, space: spaces.Space[Any]) -> specs.BoundedArray:
    """The dm_env spec of a Box, or of a Discrete space as one number.

    :raises BadInput: the space has another type.
    """
    if isinstance(space, spaces.Discrete):
        return specs.BoundedArray((1,), np.int64, [space.start], [space.start + space.n - 1])
    if isinstance(space, spaces.Box):
        return specs.BoundedArray(space.shape, space.dtype, space.low, space.high)
    raise BadInput(
        f"{name} is a {type(space).__name__}; a task takes Box and Discrete, or a Dict of them as observation"
    )


def register() -> None:
    """Register every task that is not registered yet as ``ddco/<task>-v0``."""
    for point in entry_points(group=TASKS):
        name = f"{NAMESPACE}/{point.name}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(name, "ddco_pyro.simulation.environments:TaskEnvironment", kwargs={"task": point.name})


register()
