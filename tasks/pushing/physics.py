"""The scene of the pushing task: what is measured in it, and how box and goal are put in place."""

from __future__ import annotations

import numpy as np
from mujoco import mj_step, mj_step1

from ..rendering import mujoco
from .geometry import BOX_HEIGHT

OUT_OF_SIGHT = -5.0  # m: far below the surface
RAMP = 5  # parts of a control step in which the servos' velocities change

# Where the model has them, in the order of pushing.xml; a name looked up takes as long as a time step.
JOINTS = slice(0, 3)
BOX = slice(3, 6)
TIP, GOAL = 0, 0
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
        """One control step of ``nstep`` time steps, a multiple of 5: the servos ramp to the set velocities.

        Servos of unequal inertia that were given a step would for a moment send the tip somewhere else, fast
        enough to kick the box away.
        """
        model, data = self.model.ptr, self.data.ptr
        with self.check_invalid_state():
            for number in range(1, RAMP + 1):
                data.ctrl[:] = self._from + number / RAMP * (self._to - self._from)
                mj_step(model, data, nstep // RAMP)
            mj_step1(model, data)  # what is measured belongs to where things are now

    def joint_angles(self) -> np.ndarray:
        """[3], rad."""
        return np.array(self.data.qpos[JOINTS])

    def joint_velocities(self) -> np.ndarray:
        """[3], rad/s."""
        return np.array(self.data.qvel[JOINTS])

    def tip(self) -> np.ndarray:
        """The tip of the hand: x, z (m)."""
        return np.array(self.data.site_xpos[TIP, ::2])

    def box(self) -> np.ndarray:
        """The box: x and z of its centre (m), and its tilt (rad), positive when its top leans towards -x."""
        x, raised, tilt = self.data.qpos[BOX]
        return np.array([x, BOX_HEIGHT / 2 + raised, tilt])

    def box_speed(self) -> float:
        """How fast the box's centre moves (m/s)."""
        return float(np.linalg.norm(self.data.qvel[BOX][:2]))

    def goal(self) -> float:
        """Where the box has to be: x (m)."""
        return float(self.data.mocap_pos[GOAL, 0])

    def place_arm(self, angles: np.ndarray) -> None:
        """Put the arm at joint angles [3], at rest."""
        self.data.qpos[JOINTS] = angles
        self.data.qvel[JOINTS] = 0.0

    def place_box(self, x: float) -> None:
        """Put the box upright on the surface, at rest."""
        self.data.qpos[BOX] = [x, 0.0, 0.0]
        self.data.qvel[BOX] = 0.0

    def place_goal(self, x: float) -> None:
        """Put the goal somewhere."""
        self.data.mocap_pos[GOAL] = [x, 0.0, 0.0]

    def hide_goal(self) -> None:
        """Put the goal out of sight; :meth:`goal` goes on to tell where it is."""
        self.data.mocap_pos[GOAL, 2] = OUT_OF_SIGHT
