"""Two small tasks on a line whose supervisor's intention is hidden from what is observed.

In each the supervisor moves one way or the other, 1 or -1: this is its *intention*. The observation ``seen`` does not
tell it. The observation ``intention`` tells it to a spec that names it. That is the control case,
with the same demonstrations and the same starts.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from pathlib import Path
from typing import ClassVar

import dm_env
import numpy as np
from dm_env import specs

from ddco_pyro.simulation.task import Task

SHAKING = 0.15  # of the supervisor's hand, beside a control of 1 or -1


class Line(dm_env.Environment):
    """A point on a line that a control of 1 moves by ``speed``."""

    steps: ClassVar[int]
    speed: ClassVar[float]
    sees: ClassVar[int] = 1

    def __init__(self, seed: int) -> None:
        self.seed, self.random = seed, np.random.default_rng(seed)

    def reset(self) -> dm_env.TimeStep:
        self.time, self.position, self.direction = 0, 0.0, 1 if self.seed % 2 else -1
        self.begin()
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        self.time += 1
        self.position += self.speed * float(np.clip(action[0], -2, 2))
        self.moved()
        if self.over:
            return dm_env.termination(float(self.arrived), self._observation())
        return dm_env.transition(0.0, self._observation())

    @property
    def over(self) -> bool:
        return self.time == self.steps

    @property
    @abstractmethod
    def arrived(self) -> bool:
        """Whether the episode is a success."""

    def begin(self) -> None:
        """Draw what differs between episodes."""

    def moved(self) -> None:
        """Change ``direction``, 1 or -1, and what else the last move changes."""

    def seen(self) -> list[float]:
        """What is observed where the intention is hidden."""
        return [self.position]

    def odds(self) -> float:
        """How often the supervisor's direction is 1 where it sees what is seen now."""
        return 0.5

    def _observation(self) -> dict[str, np.ndarray]:
        self.now = np.array(self.seen())
        return {"seen": self.now, "intention": np.array([float(self.direction)])}

    def observation_spec(self) -> dict[str, specs.Array]:
        return {"seen": specs.Array((self.sees,), float, "seen"), "intention": specs.Array((1,), float, "intention")}

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((1,), float, -2.0, 2.0, "velocity")


class ThereAndBack(Line):
    """To the far end at 1 and back to 0, on which the episode ends; the position is seen and the velocity is not."""

    steps, speed = 30, 0.125

    def begin(self) -> None:
        self.position, self.direction, self.been_there = self.random.uniform(0.0, 0.1), 1, False

    def moved(self) -> None:
        self.been_there |= self.position > 0.9
        self.direction = -1 if self.position > 1 else self.direction

    @property
    def over(self) -> bool:
        return self.arrived or super().over

    @property
    def arrived(self) -> bool:
        return self.been_there and self.position < 0

    def odds(self) -> float:
        return 1.0 if self.position < 0 else 0.0 if self.position > 1 else 0.5


class Obstacle(Line):
    """Past an obstacle, left or right of it: either will do. What is seen is how near it is, and, under much noise,
    how far the point is to the side.
    """

    steps, speed, sees = 12, 0.1, 2
    noise = 3.0

    @property
    def arrived(self) -> bool:
        return self.over and abs(self.position) > 0.9

    def seen(self) -> list[float]:
        return [self.time / self.steps, self.position + self.noise * self.random.normal()]

    def odds(self) -> float:
        return float(1 / (1 + np.exp(-2 * self.speed * self.time * self.now[1] / self.noise**2)))


class Supervisor:
    """Moves as it intends to, with a hand that shakes.

    :param forgetful: it draws its intention anew at every step, about as often as the supervisor has it where it sees
        what is seen. It knows both moves exactly, and lacks memory alone.
    """

    def __init__(self, environment: Line, forgetful: bool = False) -> None:
        self.environment, self.forgetful = environment, forgetful

    def reset(self, seed: int) -> None:
        self.random = np.random.default_rng([seed, 1])

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        direction = self.environment.direction
        if self.forgetful:
            direction = 1 if self.random.random() < self.environment.odds() else -1
        return direction + SHAKING * self.random.normal(size=1)


def _task(environment: type[Line]) -> Task:
    return Task(
        name=environment.__name__,
        load=environment,
        policies={"supervisor": Supervisor, "forgetful": partial(Supervisor, forgetful=True)},
        outcome=lambda ended: {"success": float(ended.arrived), "side": float(np.sign(ended.position))},
        frame=lambda environment: np.zeros((48, 64, 3), np.uint8),
        sources=(Path(__file__),),
        steps=environment.steps,
    )


there_and_back, obstacle = map(_task, (ThereAndBack, Obstacle))
