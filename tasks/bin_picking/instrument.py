"""An instrument in the arm: a bias of its own in every joint, and backlash of its cables.

Beside the smooth error of :func:`ddco_tasks.psm.encoder_error`, which the arm has with any instrument, the
joints of a da Vinci depend on the instrument that is mounted and on the direction in which they last moved.
Motors are what is commanded and read; joints are what moves the gripper. Units are those of the joints: rad,
and m for the insertion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import psm

BACKLASH = np.array([0.0015, 0.0015, 0.00015, 0.01, 0.01, 0.01])
"""By how much a motor can run ahead of its joint, either way: 0.26 mm at the gripper for the first two."""
BIAS = np.array([0.015, 0.015, 0.001, 0.03, 0.03, 0.03])
"""Standard deviations between instruments: 2.6 mm at the gripper sideways, 1 mm along the shaft."""


@dataclass(frozen=True)
class Instrument:
    """An instrument; ``bias`` [6] is added to every joint."""

    bias: np.ndarray

    @classmethod
    def numbered(cls, number: int) -> Instrument:
        """An instrument whose bias depends on its number alone; the one with number 0 has none."""
        generator = np.random.default_rng(number)
        return cls(BIAS * generator.standard_normal(6) * (number > 0))

    def joints(self, motors: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """Where the joints [6] truly are, for motors [6] that run ahead of them by ``slack`` [6]."""
        return psm.true_joints(motors - slack) + self.bias

    def motors(self, joints: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """What the motors read [6] with the joints truly at ``joints`` [6]: the inverse of :meth:`joints`."""
        return psm.encoder_readings(joints - self.bias) + slack

    def command(self, joints: np.ndarray, motors: np.ndarray, slack: np.ndarray) -> np.ndarray:
        """The motors' set points [6] that bring joints to ``joints`` [6] from ``motors`` and ``slack`` [6].

        A motor has to run ahead of its joint in the direction in which the joint is to move; where the joint
        is to stay the motor does.
        """
        wanted = self.motors(joints, np.zeros(6))
        before = motors - slack
        return wanted + np.where(wanted == before, slack, BACKLASH * np.sign(wanted - before))


def slack_after(slack: np.ndarray, move: np.ndarray) -> np.ndarray:
    """Slack [6] after motors moved by ``move`` [6] (play operator): it is taken up, then joints follow."""
    return np.clip(slack + move, -BACKLASH, BACKLASH)
