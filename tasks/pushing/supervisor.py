"""Scripted policies of pushing: way points by rule, plans by RRT-Connect. Both see what a learner can see.

Any of them can be recorded with a disturbed hand: its moves are inexact while its intentions are recorded, so
that demonstrations show how to come back from an inexact move without teaching the inexactness.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import dm_env
import numpy as np

from ddco_pyro.simulation.task import Observation, Policy

from . import geometry as geometry
from . import rules as rules
from .planner import Planner
from .rules import Scene

HAND = 0.2  # rad/s: standard deviation of what a disturbed hand adds to the velocity of each joint
SHAKIER = (0.3, 0.4)  # rad/s: more of that, for demonstrations that show more ways back
# of that, from one step to the next: white noise of the same reach would kick the box about
HAND_MEMORY = 0.8

STEP = rules.FULL_ADVANCE  # how far ahead of itself the tip aims
OVER = geometry.BOX_HEIGHT + geometry.RADIUS + 0.13  # m: tip height to cross the box
BESIDE = geometry.BOX_HEIGHT + geometry.RADIUS  # m: a tip below this is beside the box or touches it
CROSS_FROM = BESIDE + 0.03  # m: tip height from which on it crosses, the faster the higher
LAG = 0.02  # m: how far below the height to cross the tip already crosses at full speed
COLUMN = 0.04  # m: half width of the column behind the box in which the tip comes down
BAND = 0.05  # m: half height of the band in which the tip pushes
TURN_DISTANCE = 0.15  # m: the hand's pitch changes from one side of the box to the other over this half width


class Decider(Protocol):
    """A supervisor's mind: joint velocities for a scene."""

    @property
    def phase(self) -> int:
        """Of the velocities just decided: 0 approach, 1 push."""

    def reset(self, seed: int) -> None:
        """Forget the last episode."""

    def decide(self, scene: Scene) -> np.ndarray:
        """Joint velocities [3] (rad/s)."""


class WayPoints:
    """Goes to way points that are a function of the state alone: up, over the box, down behind it, push."""

    phase = 0

    def reset(self, seed: int) -> None:
        """Nothing to forget, and nothing random."""

    def decide(self, scene: Scene) -> np.ndarray:
        """Joint velocities [3] (rad/s) towards the next way point."""
        tip = geometry.tip_position(scene.angles)
        offset = way_point(tip, scene) - tip
        aim = tip + offset * min(1.0, STEP / max(float(np.linalg.norm(offset)), 1e-9))
        lean = np.clip((scene.box - aim[0]) / TURN_DISTANCE, -1.0, 1.0)
        self.phase = int(is_pushing(tip, scene))
        return rules.towards(scene.angles, geometry.inverse(aim, rules.PUSH_PITCH * lean))


def is_pushing(tip: np.ndarray, scene: Scene) -> bool:
    """Whether the tip (x, z) is behind the box and low enough to push."""
    behind = -scene.side * (tip[0] - scene.box)
    return bool(behind > geometry.BOX_HALF_WIDTH and abs(tip[1] - rules.PUSH_HEIGHT) < BAND)


def way_point(tip: np.ndarray, scene: Scene) -> np.ndarray:
    """Where a tip at (x, z) has to go next (m)."""
    side = scene.side
    along = side * (tip[0] - scene.box)  # negative: behind the box
    column = scene.box - side * rules.BEHIND
    if is_pushing(tip, scene):
        return np.array([tip[0] + side * rules.advance(scene), rules.PUSH_HEIGHT])
    if along < -geometry.BOX_HALF_WIDTH and (tip[1] < BESIDE or along < COLUMN - rules.BEHIND):
        return np.array([column, rules.PUSH_HEIGHT])
    # Up first, then across: gradually, because a switch between the two would make the tip dither at its
    # threshold.
    beside = scene.box + side * (max(along, rules.BEHIND) if tip[1] < BESIDE else along)
    across = float(np.clip((tip[1] - CROSS_FROM) / (OVER - LAG - CROSS_FROM), 0.0, 1.0))
    return np.array([beside + across * (column - beside), OVER])


class Supervisor:
    """A mind with a hand. ``intended`` is the control that the mind wanted, and is what is recorded.

    :param noise: standard deviation of what the hand adds to the velocity of each joint (rad/s).
    """

    def __init__(self, decider: Decider, noise: float = 0.0) -> None:
        self._decider, self._noise = decider, noise
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget the last episode; ``seed`` decides how inexact the moves are."""
        self._decider.reset(seed)
        self._random = np.random.default_rng(seed)
        self._disturbance = self._noise * self._random.standard_normal(3)
        self.intended = np.zeros(3)
        self._side = 0

    @property
    def annotations(self) -> dict[str, int]:
        """Of the step just decided: ``side`` (0 left, 1 right) and ``phase`` (0 approach, 1 push).

        ``skill`` is both.
        """
        side, phase = int(self._side > 0), self._decider.phase
        return {"side": side, "phase": phase, "skill": 2 * side + phase}

    def act(self, observation: Observation) -> np.ndarray:
        """Joint velocities [3] (rad/s), within what the servos can do."""
        scene = rules.scene(observation)
        self._side = scene.side
        self.intended = self._decider.decide(scene)
        fresh = self._noise * self._random.standard_normal(3)
        self._disturbance = HAND_MEMORY * self._disturbance + np.sqrt(1.0 - HAND_MEMORY**2) * fresh
        return np.clip(self.intended + self._disturbance, -geometry.MAX_SPEED, geometry.MAX_SPEED)


def policy(make: Callable[[], Decider], noise: float = 0.0) -> Callable[[dm_env.Environment], Policy]:
    """What a task registers: makes a supervisor for an environment, whose state it does not look at."""
    return lambda environment: Supervisor(make(), noise)


def _every_step() -> Planner:
    return Planner("every_step")


POLICIES = {
    "supervisor": policy(Planner),
    "supervisor_noisy": policy(Planner, HAND),
    "supervisor_every_step": policy(_every_step),
    "supervisor_every_step_noisy": policy(_every_step, HAND),
    "scripted": policy(WayPoints),
    "scripted_noisy": policy(WayPoints, HAND),
    **{f"scripted_noisy_{noise}": policy(WayPoints, noise) for noise in SHAKIER},
    **{f"supervisor_noisy_{noise}": policy(Planner, noise) for noise in SHAKIER},
}
