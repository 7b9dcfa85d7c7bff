"""The shape of the needle, and the gripper poses that its grasp and its insertion ask for.

The needle's frame: origin in the middle of the arc, x along the wire towards the tip, the arc bends towards
y. Metres and radians.
"""

from __future__ import annotations

import numpy as np

from ..psm import Pose, rotation
from ..vision import principal_angle

ARC_RADIUS = 0.013  # m
ARC_HALF_ANGLE = np.pi / 4  # a quarter of a circle
WIRE_RADIUS = 0.0005  # m
# heading of the middle of the arc when the tip points along +x, into the phantom
MIDDLE_HEADING = -ARC_HALF_ANGLE
TIP = ARC_RADIUS * np.array([np.sin(ARC_HALF_ANGLE), 1.0 - np.cos(ARC_HALF_ANGLE), 0.0])
TIP_DIRECTION = np.array([np.cos(ARC_HALF_ANGLE), np.sin(ARC_HALF_ANGLE), 0.0])
ELLIPSE_CENTRE = np.array([0.0, 0.00226, 0.0])  # of the hull's ellipse, in the needle's frame

# The gripper holds the middle of the arc, with its y axis along the wire and away from the tip.
NOMINAL_GRIP = Pose(rotation(2, -np.pi / 2), np.zeros(3))  # the needle in the gripper's frame


def arc_coordinate(point: np.ndarray) -> float:
    """Place along the wire (m, from the middle to the tip) nearest to a point [3] of the needle's frame."""
    angle = np.arctan2(point[0], ARC_RADIUS - point[1])
    return float(ARC_RADIUS * np.clip(angle, -ARC_HALF_ANGLE, ARC_HALF_ANGLE))


def arc_tangent(coordinate: float) -> np.ndarray:
    """Direction of the wire [3] in the needle's frame at a position along it (m)."""
    angle = coordinate / ARC_RADIUS
    return np.array([np.cos(angle), np.sin(angle), 0.0])


def lying_needle(features: np.ndarray) -> Pose:
    """The pose of a needle on the mat, from its ellipse [6] (mm; :func:`ddco_tasks.vision.ellipse`).

    An ellipse looks the same after half a turn: of the two headings, the one nearer to the phantom is taken.
    """
    turn = rotation(2, principal_angle(features, near=MIDDLE_HEADING))
    centre = np.array([features[0], features[1], 0.0]) * 1e-3 + np.array([0.0, 0.0, WIRE_RADIUS])
    return Pose(turn, centre - turn @ ELLIPSE_CENTRE)


def upright(heading: float, position: np.ndarray) -> Pose:
    """A gripper that points straight down at ``position`` [3] to hold a wire of that heading (rad)."""
    return Pose(rotation(2, heading + np.pi / 2), position)


def grasp_pose(needle: Pose) -> Pose:
    """Where the gripper has to be to close on the middle of the needle's arc."""
    return upright(float(np.arctan2(needle.rotation[1, 0], needle.rotation[0, 0])), needle.position)


def insertion_pose(grip: Pose, tip: np.ndarray) -> Pose:
    """The upright gripper pose that brings the needle's tip to ``tip`` [3], heading along +x.

    :param grip: the needle in the gripper's frame.
    """
    direction = grip.rotation @ TIP_DIRECTION
    turn = rotation(2, -float(np.arctan2(direction[1], direction[0])))
    return Pose(turn, tip - turn @ grip.apply(TIP))
