"""A small task for tests: a point in the plane has to pass by one place and then reach another."""

from dataclasses import replace
from pathlib import Path

import dm_env
import numpy as np
from dm_env import specs

from ddco_pyro.simulation.cameras import Camera
from ddco_pyro.simulation.task import Task

STEPS = 12
SPEED = 0.3  # distance at full control, in each direction
REACH = 0.25  # closer than this is there
MEANS = np.array([[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])  # of start, via-point and goal


class Point(dm_env.Environment):
    """Starts near (-1, 0); the via-point lies near (0, 1), the goal near (1, 0)."""

    def __init__(self, seed: int, steps: int = STEPS) -> None:
        self._random, self._steps = np.random.default_rng(seed), steps
        self.closed = False

    def reset(self) -> dm_env.TimeStep:
        self.position, self.via, self.goal = MEANS + self._random.uniform(-0.2, 0.2, (3, 2))
        self.visited, self.time = False, 0
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        self.time += 1
        self.position = self.position + SPEED * np.clip(action, -1, 1)
        self.visited = self.visited or self.distance(self.via) < REACH
        if self.arrived or self.time == self._steps:
            return dm_env.termination(float(self.arrived), self._observation())
        return dm_env.transition(0.0, self._observation())

    @property
    def arrived(self) -> bool:
        return self.visited and self.distance(self.goal) < REACH

    def distance(self, place: np.ndarray) -> float:
        return float(np.linalg.norm(self.position - place))

    def _observation(self) -> dict[str, np.ndarray]:
        offsets = np.concatenate([self.via - self.position, self.goal - self.position])
        return {"offsets": offsets, "visited": np.array([float(self.visited)])}

    def observation_spec(self) -> dict[str, specs.Array]:
        sizes = {"offsets": (4,), "visited": (1,)}
        return {name: specs.Array(size, float, name) for name, size in sizes.items()}

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((2,), float, -1.0, 1.0, "velocity")

    def close(self) -> None:
        self.closed = True


class Supervisor:
    """Goes to the via-point and then to the goal, with a hand that shakes."""

    def __init__(self, environment: Point) -> None:
        self.environment = environment
        self.annotations: dict[str, int] = {}

    def reset(self, seed: int) -> None:
        self._random = np.random.default_rng([seed, 1])

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        phase = int(self.environment.visited)
        self.annotations = {"phase": phase}
        target = observation["offsets"].reshape(2, 2)[phase]
        return np.clip(target / SPEED + 0.1 * self._random.normal(size=2), -1, 1)


class OpenLoop:
    """Plays the movement that suits the places' means, without looking."""

    def __init__(self, environment: Point) -> None:
        pass

    def reset(self, seed: int) -> None:
        self.time = 0

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        self.time += 1
        return np.array([0.83, 0.83] if self.time <= 4 else [0.83, -0.83])


def outcome(environment: Point) -> dict[str, float]:
    error = environment.distance(environment.goal) if environment.visited else np.nan
    return {"success": float(environment.arrived), "error": error}


def frame(environment: Point) -> np.ndarray:
    picture = np.full((48, 65, 3), 255, np.uint8)
    column, row = np.clip((environment.position + 1.5) / 3 * [64, 47], 0, [64, 47]).astype(int)
    picture[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = 0
    return picture


task = Task(
    name="toy",
    load=Point,
    policies={"supervisor": Supervisor, "open_loop": OpenLoop},
    outcome=outcome,
    frame=frame,
    sources=(Path(__file__),),
    measures={"success": "rate", "error": "mean"},
)
DRAWN: list[int] = []
"""The times at which the camera of ``watched`` has drawn a picture in this process."""


def _draw(environment: Point) -> np.ndarray:
    DRAWN.append(environment.time)
    return frame(environment)


watched = replace(task, cameras={"camera": Camera((48, 65), _draw)})
short = replace(task, name="short", load=lambda seed: Point(seed, 5), steps=5)

SPEC = """
task: toy
demonstrations: {count: 12, labels: phase, valid_fraction: 0.25}
observations: [offsets, visited]
control: {std: 0.5}
hierarchy:
  levels:
    - {count: 2, policy: {hidden: [8]}}
  meta_policy: {hidden: [8]}
compare_with: [flat, per_timestep]
training: {epochs: 24, batch_size: 3, optimizer: {lr: 0.01}}
rollout: {episodes: 4, policies: [open_loop, supervisor]}
"""
