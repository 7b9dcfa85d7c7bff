"""The scene of the pushing task: what is measured in it, and how box and goal are put in place."""

from __future__ import annotations

import numpy as np

from .pushing_geometry import BOX_HEIGHT
from .rendering import mujoco

RAMP = 5  # parts of a control step in which the servos' velocities change

JOINTS = ["shoulder", "elbow", "wrist"]
BOX = ["box_x", "box_z", "box_tilt"]
LINKS = ("upper", "fore", "hand")


class Physics(mujoco.Physics):
    """The scene, with what the task measures in it."""

    _from = np.zeros(3)
    _to = np.zeros(3)

    def reset(self, keyframe_id: int | None = None) -> None:
        """Back to the model's own state: nothing moves."""
        self._from = self._to = np.zeros(3)
        super().reset(keyframe_id)

    def set_velocities(self, velocities: np.ndarray) -> None:
        """Set the joint velocities [3] (rad/s) of the next control step."""
        self._from, self._to = self._to, np.array(velocities, float)

    def step(self, nstep: int = 1) -> None:
        """One control step of ``nstep`` time steps, a multiple of 5: the servos ramp to the velocities that were set.

        Servos of unequal inertia that were given a step would for a moment send the tip somewhere else, fast enough to
        kick the box away.
        """
        for number in range(1, RAMP + 1):
            self.set_control(self._from + number / RAMP * (self._to - self._from))
            super().step(nstep // RAMP)

    def joint_angles(self) -> np.ndarray:
        """[3], rad."""
        return np.array(self.named.data.qpos[JOINTS])

    def joint_velocities(self) -> np.ndarray:
        """[3], rad/s."""
        return np.array(self.named.data.qvel[JOINTS])

    def tip(self) -> np.ndarray:
        """The tip of the hand: x, z (m)."""
        return np.array(self.named.data.site_xpos["tip", ["x", "z"]])

    def box(self) -> np.ndarray:
        """The box: x and z of its centre (m), and its tilt (rad), positive when its top leans towards -x."""
        x, raised, tilt = self.named.data.qpos[BOX]
        return np.array([x, BOX_HEIGHT / 2 + raised, tilt])

    def box_speed(self) -> float:
        """How fast the box's centre moves (m/s)."""
        return float(np.linalg.norm(self.named.data.qvel[BOX[:2]]))

    def goal(self) -> float:
        """Where the box has to be: x (m)."""
        return float(self.named.data.mocap_pos["goal", "x"])

    def place_arm(self, angles: np.ndarray) -> None:
        """Put the arm at joint angles [3], at rest."""
        self.named.data.qpos[JOINTS] = angles
        self.named.data.qvel[JOINTS] = 0.0

    def place_box(self, x: float) -> None:
        """Put the box upright on the surface, at rest."""
        self.named.data.qpos[BOX] = [x, 0.0, 0.0]
        self.named.data.qvel[BOX] = 0.0

    def place_goal(self, x: float) -> None:
        """Put the goal somewhere."""
        self.named.data.mocap_pos["goal"] = [x, 0.0, 0.0]
