"""The simulated arm of the surgical tasks: how it goes to the goal of a control step, and where it is."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from . import psm
from .rendering import mujoco

SET_POINT_TIME = 0.02  # s, between interpolated set points
SERVOS = [*psm.JOINTS, "jaw_left", "jaw_right"]


class ArmPhysics(mujoco.Physics):
    """A scene with the arm in it; its servos are the six joints and each jaw."""

    move_time: ClassVar[float]
    """Seconds to reach the goal of a control step."""
    _from = np.zeros(8)
    _to = np.zeros(8)

    def place_servos(self, joints: np.ndarray, jaw: float) -> None:
        """Put the arm at true joints [6] and the jaws at an angle (rad), at rest."""
        servos = np.concatenate([joints, [jaw / 2, jaw / 2]])
        self.named.data.qpos[SERVOS] = servos
        self._from = self._to = servos
        self.set_control(servos)

    def aim(self, joints: np.ndarray, jaw: float) -> None:
        """Set the goal of the next control step: true joints [6] and the angle between the jaws (rad)."""
        self._from, self._to = self._to, np.concatenate([joints, [jaw / 2, jaw / 2]])

    def step(self, nstep: int = 1) -> None:
        """One control step of ``nstep`` time steps: to the goal along smooth set points, then settle."""
        block = round(SET_POINT_TIME / self.timestep())
        for start in range(0, nstep, block):
            fraction = min(1.0, (start + block) * self.timestep() / self.move_time)
            blend = fraction**3 * (10.0 - 15.0 * fraction + 6.0 * fraction**2)  # minimum jerk
            self.set_control(self._from + blend * (self._to - self._from))
            self.advance(block)

    def advance(self, steps: int) -> None:
        """Simulate time steps with the set points as they are."""
        super().step(steps)

    def true_joints(self) -> np.ndarray:
        """Joints [6] as they are (rad, m)."""
        return np.array(self.named.data.qpos[list(psm.JOINTS)])

    def jaw(self) -> float:
        """The angle between the jaws (rad)."""
        return float(np.sum(self.named.data.qpos[["jaw_left", "jaw_right"]]))

    def gripper(self) -> psm.Pose:
        """The gripper's true pose."""
        return self.site("gripper")

    def site(self, name: str) -> psm.Pose:
        """The pose of a site of the model."""
        data = self.named.data
        return psm.Pose(np.array(data.site_xmat[name]).reshape(3, 3), np.array(data.site_xpos[name]))
