"""Tasks as Gymnasium environments (``pip install 'ddco-pyro[gymnasium]'``).

    import gymnasium
    import ddco_pyro.simulation.environments    # registers ddco/<task>-v0 for every task

    environment = gymnasium.make("ddco/needle-v0")

``gymnasium.make("ddco_pyro.simulation.environments:ddco/needle-v0")`` does both at once. The other direction is
:meth:`ddco_pyro.simulation.task.Task.from_gymnasium`.
"""

from __future__ import annotations

from collections.abc import Collection
from importlib.metadata import entry_points
from typing import Any

import dm_env
import gymnasium
import numpy as np
from dm_env import specs
from gymnasium import spaces

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


def register() -> None:
    """Register every task that is not registered yet as ``ddco/<task>-v0``."""
    for point in entry_points(group=TASKS):
        name = f"{NAMESPACE}/{point.name}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(name, "ddco_pyro.simulation.environments:TaskEnvironment", kwargs={"task": point.name})


register()
