"""A small task on a line whose supervisor's intention is hidden from what is observed.

The supervisor moves one way or the other, 1 or -1: this is its *intention*. The observation ``seen`` does not tell it.
The observation ``intention`` tells it to a spec that names it. That is the control case, with the same demonstrations
and the same starts.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import dm_env
import numpy as np
from dm_env import specs

from ddco_pyro.simulation.task import Task

SHAKING = 0.15  # of the supervisor's hand, beside a control of 1 or -1
STEPS, SPEED = 30, 0.125


class ThereAndBack(dm_env.Environment):
    """To the far end at 1 and back to 0, on which the episode ends; the position is seen and the velocity is not."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def reset(self) -> dm_env.TimeStep:
        self.time, self.position, self.direction, self.been_there = 0, self.random.uniform(0.0, 0.1), 1, False
        return dm_env.restart(self._observation())

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        self.time += 1
        self.position += SPEED * float(np.clip(action[0], -2, 2))
        self.been_there |= self.position > 0.9
        self.direction = -1 if self.position > 1 else self.direction
        if self.arrived or self.time == STEPS:
            return dm_env.termination(float(self.arrived), self._observation())
        return dm_env.transition(0.0, self._observation())

    @property
    def arrived(self) -> bool:
        return self.been_there and self.position < 0

    def odds(self) -> float:
        """How often the supervisor's direction is 1 where it sees what is seen now."""
        return 1.0 if self.position < 0 else 0.0 if self.position > 1 else 0.5

    def _observation(self) -> dict[str, np.ndarray]:
        return {"seen": np.array([self.position]), "intention": np.array([float(self.direction)])}

    def observation_spec(self) -> dict[str, specs.Array]:
        return {name: specs.Array((1,), float, name) for name in ("seen", "intention")}

    def action_spec(self) -> specs.BoundedArray:
        return specs.BoundedArray((1,), float, -2.0, 2.0, "velocity")


class Supervisor:
    """Moves as it intends to, with a hand that shakes.

    :param forgetful: it draws its intention anew at every step, about as often as the supervisor has it where it sees
        what is seen. It knows both moves exactly, and lacks memory alone.
    """

    def __init__(self, environment: ThereAndBack, forgetful: bool = False) -> None:
        self.environment, self.forgetful = environment, forgetful

    def reset(self, seed: int) -> None:
        self.random = np.random.default_rng([seed, 1])

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        direction = self.environment.direction
        if self.forgetful:
            direction = 1 if self.random.random() < self.environment.odds() else -1
        return direction + SHAKING * self.random.normal(size=1)


there_and_back = Task(
    name="there and back",
    load=ThereAndBack,
    policies={"supervisor": Supervisor, "forgetful": partial(Supervisor, forgetful=True)},
    outcome=lambda ended: {"success": float(ended.arrived)},
    frame=lambda environment: np.zeros((48, 64, 3), np.uint8),
    sources=(Path(__file__),),
    steps=STEPS,
)
