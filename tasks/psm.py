"""Kinematics of a da Vinci-like patient-side manipulator (PSM), and the error of its joint encoders.

Six joints, in this order: yaw and pitch about the remote centre of motion (RCM), insertion of the instrument
through it, roll about the shaft, wrist pitch and, 9.1 mm further, wrist yaw; the jaws hinge on the wrist yaw
axis. Lengths are metres, angles radians. A gripper pose is a rotation [3, 3] and a position [3] in the world:
its z axis points back along the gripper, its x axis is the direction in which the jaws open, so a needle is
held along its y axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")
JOINT_RANGES = np.array([[-0.8, 0.8], [-0.8, 0.8], [0.05, 0.24], [-2.6, 2.6], [-1.4, 1.4], [-1.4, 1.4]])
BASE_TILT = np.deg2rad(40.0)  # the shaft leans this much from the vertical at zero yaw and pitch
RCM_DISTANCE = 0.170  # m, from the centre of the workspace
WRIST_LENGTH = 0.0091  # m, wrist pitch axis to wrist yaw axis
JAW_LENGTH = 0.0102  # m, wrist yaw axis to the middle of the pads
RCM = RCM_DISTANCE * np.array([0.0, -np.sin(BASE_TILT), np.cos(BASE_TILT)])


def rotation(axis: int, angle: float) -> np.ndarray:
    """Rotation matrix [3, 3] about coordinate axis 0, 1 or 2 by ``angle`` (rad)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((3, 3))
    matrix[axis, axis] = 1.0
    matrix[i, i] = matrix[j, j] = cosine
    matrix[j, i], matrix[i, j] = sine, -sine
    return matrix


BASE = rotation(0, BASE_TILT)


@dataclass(frozen=True)
class Pose:
    """A rotation [3, 3] and a position [3] (m)."""

    rotation: np.ndarray
    position: np.ndarray

    def __matmul__(self, other: Pose) -> Pose:
        """The pose ``other``, given in this frame, in the frame that this pose is given in."""
        return Pose(self.rotation @ other.rotation, self.apply(other.position))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] of this frame, outside it."""
        return points @ self.rotation.T + self.position

    def inverse(self) -> Self:
        """The pose of the outer frame seen from this one."""
        return type(self)(self.rotation.T, -self.rotation.T @ self.position)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Axis times angle [3] (rad) of a rotation of less than half a turn."""
    antisymmetric = 0.5 * np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    sine = float(np.linalg.norm(antisymmetric))
    angle = np.arctan2(sine, 0.5 * (np.trace(matrix) - 1.0))
    return antisymmetric * (angle / sine if sine > 1e-9 else 1.0)


def forward(joints: np.ndarray) -> Pose:
    """The gripper's pose for joints [6]."""
    yaw, pitch, insertion, roll, wrist_pitch, wrist_yaw = joints
    shaft = BASE @ rotation(1, yaw) @ rotation(0, pitch)
    wrist = shaft @ rotation(2, roll) @ rotation(0, wrist_pitch)
    gripper = wrist @ rotation(1, wrist_yaw)
    position = RCM - insertion * shaft[:, 2] - WRIST_LENGTH * wrist[:, 2] - JAW_LENGTH * gripper[:, 2]
    return Pose(gripper, position)


def inverse(pose: Pose) -> np.ndarray:
    """The joints [6] that bring the gripper to ``pose``, in closed form.

    The wrist's link is normal to the wrist yaw axis and lies in the plane of that axis and the RCM, which
    gives the wrist pitch axis and from it the shaft; what remains of the rotation is roll, wrist pitch and
    wrist yaw.
    """
    yaw_axis = pose.rotation[:, 1]
    wrist = pose.position + JAW_LENGTH * pose.rotation[:, 2]
    from_rcm = wrist - RCM
    link = from_rcm - (from_rcm @ yaw_axis) * yaw_axis
    shaft = wrist - WRIST_LENGTH * link / np.linalg.norm(link) - RCM
    insertion = float(np.linalg.norm(shaft))
    direction = BASE.T @ shaft / insertion
    pitch = np.arcsin(direction[1])
    yaw = np.arctan2(-direction[0], -direction[2])
    rest = (BASE @ rotation(1, yaw) @ rotation(0, pitch)).T @ pose.rotation
    last = np.arctan2(-rest[2, 0], rest[2, 2])
    wrist_angles = (np.arctan2(-rest[0, 1], rest[1, 1]), np.arcsin(rest[2, 1]), last)
    return np.array([yaw, pitch, insertion, *wrist_angles])


# Cable stretch and friction make the joints differ from what the encoders on the motors say. The difference
# is a fixed, smooth function of the joints: small in one part of the workspace, clearly larger in the other.
# The constants were fitted to the paper's figures after registration: 3.3 mm RMSE, 4.7 mm at the 75th
# percentile of the workspace.
ERROR_SMALL = 0.0008  # m
ERROR_LARGE = 0.0060  # m
ERROR_BORDER = 0.4
ERROR_SHARPNESS = 4.5
WRIST_ERROR = 0.025  # rad


def encoder_error(joints: np.ndarray) -> np.ndarray:
    """True joints minus encoder readings [6] (rad, m), where the encoders read ``joints`` [6]."""
    across, along = joints[0] / 0.3, joints[1] / 0.3  # -1 ... 1 over the workspace
    depth = (joints[2] - 0.15) / 0.03
    region = np.sin(1.1 * across - 1.3 * along + 0.4 * depth + 0.5)
    part = 1.0 + np.exp(-ERROR_SHARPNESS * (region - ERROR_BORDER))
    size = ERROR_SMALL + (ERROR_LARGE - ERROR_SMALL) / part
    heading = 1.3 * across + 1.1 * along - 0.6
    elevation = 0.5 * np.sin(0.9 * across - 0.7 * along + 0.8)
    sideways = size * np.cos(elevation) / RCM_DISTANCE
    return np.array(
        [
            sideways * np.cos(heading),
            sideways * np.sin(heading),
            size * np.sin(elevation),
            WRIST_ERROR * np.sin(1.2 * across + 0.3 * joints[3]),
            WRIST_ERROR * np.sin(0.9 * along + 0.4),
            WRIST_ERROR * np.cos(1.1 * across - 0.8 * along + 0.6),
        ]
    )


def true_joints(encoders: np.ndarray) -> np.ndarray:
    """Where the joints [6] really are when the encoders read ``encoders`` [6]."""
    return encoders + encoder_error(encoders)


def encoder_readings(joints: np.ndarray) -> np.ndarray:
    """What the encoders read [6] with the joints truly at ``joints`` [6]: inverse of :func:`true_joints`."""
    encoders = joints - encoder_error(joints)
    for _ in range(20):  # a contraction: the error varies by far less than the joints do
        encoders = joints - encoder_error(encoders)
    return encoders
