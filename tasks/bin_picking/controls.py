"""The forms of a control: joint angles, or the gripper's pose in one of two representations (SM 1.4,
"Coordinate Systems").

Each says where the arm is to go in terms of what its encoders are to read, and ends with the jaw. A pose is
that of ``kin``: what kinematics make of the encoders, which is not where the gripper truly goes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import dm_env
import numpy as np
from dm_env import specs
from scipy.spatial.transform import Rotation

from ddco_pyro.simulation.task import Observation, Policy

from .. import psm

# mm, from the remote centre of motion
REACH = 1e3 * (psm.JOINT_RANGES[2, 1] + psm.WRIST_LENGTH + psm.JAW_LENGTH)
JAW = "jaw"


@dataclass(frozen=True)
class Controls:
    """A form of controls [A]: numbers [A - 1] that the encoders of the joints are to read, and the jaw.

    :param names: of the numbers.
    :param ranges: least and greatest of each, [A - 1, 2].
    :param to_joints: from numbers to joints [6] (rad, insertion in m); it need not regard their limits.
    :param of_joints: the inverse.
    """

    names: tuple[str, ...]
    ranges: np.ndarray
    to_joints: Callable[[np.ndarray], np.ndarray]
    of_joints: Callable[[np.ndarray], np.ndarray]

    def spec(self) -> specs.BoundedArray:
        """Of a control [A]; the jaw opens above one half and closes otherwise."""
        limits = np.vstack([self.ranges, [0.0, 1.0]])
        name = ",".join((*self.names, JAW))
        return specs.BoundedArray((len(limits),), float, limits[:, 0], limits[:, 1], name=name)

    def joints(self, control: np.ndarray) -> np.ndarray:
        """The joints [6] of a control [A], each within its limits; NaN where there are none."""
        if not np.isfinite(control).all():
            return np.full(6, np.nan)
        with np.errstate(invalid="ignore"):  # a wrist in the remote centre of motion has no joints
            return np.clip(self.to_joints(control[:-1]), *psm.JOINT_RANGES.T)

    def control(self, joints_and_jaw: np.ndarray) -> np.ndarray:
        """The control [A] of joints and the jaw [7]."""
        return np.append(self.of_joints(joints_and_jaw[:6]), joints_and_jaw[6])


class Scripted:
    """A scripted policy of joint angles whose controls are given in a form."""

    def __init__(
        self,
        policy: Callable[[dm_env.Environment], Policy],
        controls: Controls,
        environment: dm_env.Environment,
    ) -> None:
        self._policy, self._controls = policy(environment), controls

    def reset(self, seed: int) -> None:
        """Forget the last episode."""
        self._policy.reset(seed)

    def act(self, observation: Observation) -> np.ndarray:
        """The next control [A]; ``intended`` is the one that was meant."""
        control = self._policy.act(observation)
        self.intended = self._controls.control(getattr(self._policy, "intended", control))
        return self._controls.control(control)

    @property
    def annotations(self) -> dict[str, int]:
        """Those of the policy."""
        return dict(getattr(self._policy, "annotations", {}))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] nearest to a matrix [3, 3] in the Frobenius norm (orthogonal Procrustes)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _of_pose(numbers: np.ndarray) -> np.ndarray:
    return psm.inverse(psm.Pose(Rotation.from_rotvec(numbers[3:]).as_matrix(), numbers[:3] / 1e3))


def _to_pose(joints: np.ndarray) -> np.ndarray:
    pose = psm.forward(joints)
    return np.concatenate([pose.position * 1e3, psm.rotation_vector(pose.rotation)])


def _of_matrix(numbers: np.ndarray) -> np.ndarray:
    return psm.inverse(psm.Pose(nearest_rotation(numbers[3:].reshape(3, 3)), numbers[:3] / 1e3))


def _to_matrix(joints: np.ndarray) -> np.ndarray:
    pose = psm.forward(joints)
    # rounding may lead beyond
    return np.concatenate([pose.position * 1e3, pose.rotation.ravel().clip(-1, 1)])


_POSITION = np.stack([1e3 * psm.RCM - REACH, 1e3 * psm.RCM + REACH], axis=1)
_AXES = ("x", "y", "z")

JOINTS = Controls(psm.JOINTS, psm.JOINT_RANGES, np.array, np.array)
"""Six joint angles (rad; the insertion in m), the paper's controls."""
POSE = Controls(
    (*_AXES, *(f"turn_{axis}" for axis in _AXES)),
    np.vstack([_POSITION, np.tile([-np.pi, np.pi], (3, 1))]),
    _of_pose,
    _to_pose,
)
"""Position (mm) and rotation vector (rad) of the gripper."""
MATRIX = Controls(
    (*_AXES, *(f"r_{row}{column}" for row in _AXES for column in _AXES)),
    np.vstack([_POSITION, np.tile([-1.0, 1.0], (9, 1))]),
    _of_matrix,
    _to_matrix,
)
"""Position (mm) of the gripper and its rotation matrix, by rows; for other matrices the nearest rotation."""
