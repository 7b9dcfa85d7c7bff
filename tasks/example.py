"""A worked example of one's own task: a point has to pass a gate and then reach its goal.

``task: ddco_tasks.example:task`` in a spec uses this one. It needs numpy and dm_env alone.
"""

from __future__ import annotations

from pathlib import Path

import dm_env
import numpy as np
from dm_env import specs

from ddco_pyro.simulation.task import Observation, Task

STEPS, NEAR = 40, 0.15


class PointMass(dm_env.Environment):
    """A point with a velocity in [-1, 1]² as its control; gate and goal are drawn by the seed."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode."""
        self.point = np.zeros(2)
        self.gate, self.goal = np.array([[1.0, 1.0], [2.0, 0.0]]) + self._random.uniform(-0.3, 0.3, (2, 2))
        self.passed, self.time = False, 0
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """One control step."""
        self.point, self.time = self.point + 0.2 * np.clip(action, -1, 1), self.time + 1
        self.passed |= bool(np.linalg.norm(self.gate - self.point) < NEAR)
        if self.arrived() or self.time == STEPS:
            return dm_env.termination(float(self.arrived()), self._observation())
        return dm_env.transition(0.0, self._observation())

    def arrived(self) -> bool:
        """Whether the point has passed the gate and is at the goal."""
        return self.passed and bool(np.linalg.norm(self.goal - self.point) < NEAR)

    def _observation(self) -> dict[str, np.ndarray]:
        offsets = np.concatenate([self.gate - self.point, self.goal - self.point])
        return {"offsets": offsets, "passed": np.array([float(self.passed)])}

    def observation_spec(self) -> dict[str, specs.Array]:
        """The spec of each observation."""
        return {"offsets": specs.Array((4,), float), "passed": specs.Array((1,), float)}

    def action_spec(self) -> specs.BoundedArray:
        """The spec of the velocity."""
        return specs.BoundedArray((2,), float, -1.0, 1.0)


class Supervisor:
    """Moves to the gate, then to the goal; its phase becomes a ground-truth label."""

    def __init__(self, environment: dm_env.Environment) -> None:
        self.environment = environment
        self.annotations: dict[str, int] = {}

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self._noise = np.random.default_rng([seed, 1])

    def act(self, observation: Observation) -> np.ndarray:
        """The control [2]."""
        phase = int(observation["passed"][0])
        self.annotations = {"phase": phase}
        towards = observation["offsets"].reshape(2, 2)[phase] / 0.2
        return np.asarray(np.clip(towards + 0.05 * self._noise.normal(size=2), -1, 1))


def _frame(environment: dm_env.Environment) -> np.ndarray:
    """A picture of the scene, uint8 [96, 144, 3]: gate, goal and point as squares."""
    picture = np.full((96, 144, 3), 255, np.uint8)
    places = (environment.gate, (0, 160, 0)), (environment.goal, (200, 0, 0)), (environment.point, (0, 0, 0))
    for (x, y), colour in places:
        row, column = int(72 - 40 * y), int(24 + 40 * x)
        picture[max(row - 3, 0) : max(row + 3, 0), max(column - 3, 0) : max(column + 3, 0)] = colour
    return picture


task = Task(
    name="example",
    load=PointMass,
    policies={"supervisor": Supervisor},
    outcome=lambda environment: {"success": float(environment.arrived()), "steps": float(environment.time)},
    frame=_frame,
    sources=(Path(__file__),),  # demonstrations are collected anew when this file changes
    steps=STEPS,
    measures={"success": "rate", "steps": "mean"},
)
