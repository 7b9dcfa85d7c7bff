"""How to push, as both supervisors know it: what is behind the box, how high to push, how fast to move.

Everything is written for a box that has to go right; ``side`` (-1 or 1) mirrors it for a box that has to go
left. The elbow always bends the same way, so the two are different motions of the arm: forehand and backhand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddco_pyro.simulation.task import Observation

from .geometry import CONTACT, MAX_SPEED

PUSH_HEIGHT = 0.10  # m: a push above half width / friction = 0.2 m would topple the box
PUSH_PITCH = 0.3  # rad: the hand leans so that the tip leads
BEHIND = CONTACT + 0.08  # m: from the box's centre to where the tip comes down
# The box is pushed to its goal without coming to a halt before it. Once it passes, the goal is on the other
# side: the tip turns back, and friction stops the box at once.
FOLLOW_THROUGH = 0.02  # m: how far ahead of itself the tip aims when the box is at its goal
SLOW_DOWN = 0.6  # more, per m that remains
FULL_ADVANCE = 0.1  # m: at most
GAIN = 5.0  # 1/s: joint velocity per angle that is missing
MAX_COMMAND = 0.8 * MAX_SPEED  # rad/s: leaves room for corrections


class Scene(NamedTuple):
    """What an observation says: joint angles [3] (rad); the box's and the goal's x (m)."""

    angles: np.ndarray
    box: float
    goal: float

    @property
    def side(self) -> int:
        """Where the goal is: to the left (-1) or right (1) of the box."""
        return 1 if self.goal > self.box else -1


def scene(observation: Observation) -> Scene:
    """The scene of an observation."""
    box, goal = float(observation["box_pose"][0]), float(observation["goal"][0])
    return Scene(np.array(observation["joint_angles"], float), box, goal)


def advance(scene: Scene) -> float:
    """How far ahead of itself the tip aims while it pushes (m)."""
    return min(FULL_ADVANCE, SLOW_DOWN * abs(scene.goal - scene.box) + FOLLOW_THROUGH)


def towards(angles: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Joint velocities [3] (rad/s) from joint angles to others: proportional, slowed alike above a limit."""
    velocity = GAIN * (target - angles)
    return velocity * min(1.0, MAX_COMMAND / max(float(np.abs(velocity).max()), 1e-9))
