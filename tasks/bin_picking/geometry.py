"""Where things are: bin, cups, places of a trial's way points, and pixels of the overhead stereo pair.

Metres and radians; pixels are counted from the centre of the upper left one. The world's origin is on the
bin's floor, between the cups; x points towards the reject cup, y away from the arm.
"""

from __future__ import annotations

import numpy as np

from ..psm import Pose, rotation

BIN_OUTSIDE = 0.029  # half the width of the bin, with its walls, and from the pile's middle to its near end
BIN_INSIDE = 0.025
BIN_FAR = 0.045  # by which its far end is further away than the near one
CUPS = {"accept": np.array([-0.061, 0.0]), "reject": np.array([0.061, 0.0])}
CUP_INSIDE = 0.026  # half the side
FOAM_DEPTH = 0.006  # the foam gives way so far under the jaws

NEUTRAL_TURN = np.pi / 4  # of the gripper about the vertical, over the cups
SHOWN_TURN = np.pi / 2  # where it shows what it holds, which is then along the bin's far wall
GRASP_HEIGHT = 0.003  # of the middle of the pads
SHOWING = np.array([0.0, 0.039, 0.038])  # over the bin's far end, where nothing stays
RETURNING = np.array([0.0, 0.004, 0.024])  # over the pile again, where what is not to be carried is let go

IMAGE_SIZE = 288  # pixels by side, as rendered
CAMERA_HEIGHT = 0.650
BASELINE = 0.005
CAMERA_Y = 0.0145
FIELD_OF_VIEW = np.deg2rad(7.1307)
FOCAL_LENGTH = IMAGE_SIZE / 2 / np.tan(FIELD_OF_VIEW / 2)  # pixels
MIDDLE = (IMAGE_SIZE - 1) / 2
OBJECT_HEIGHT = 0.001  # of what lies on the floor; its depth in the pictures is taken for this


def upright(turn: float, position: np.ndarray) -> Pose:
    """A gripper pointing straight down at ``position`` [3], turned by ``turn`` (rad) about the vertical."""
    return Pose(rotation(2, turn), position)


def nearest_turn(turn: float) -> float:
    """The turn within a right angle of the neutral one that brings the jaws into the same line."""
    return float(turn - np.pi * np.round((turn - NEUTRAL_TURN) / np.pi))


def project(points: np.ndarray, right: bool = False) -> np.ndarray:
    """Pixels [..., 2] (column, row) of points [..., 3] in the picture of the left or the right eye."""
    eye = np.array([BASELINE / 2 if right else -BASELINE / 2, CAMERA_Y, CAMERA_HEIGHT])
    seen = np.asarray(points) - eye
    scale = FOCAL_LENGTH / -seen[..., 2]
    return np.stack([MIDDLE + scale * seen[..., 0], MIDDLE - scale * seen[..., 1]], axis=-1)


def lying_at(pixel: np.ndarray) -> np.ndarray:
    """The point [..., 3] of a lying object that the left eye sees at ``pixel`` [..., 2]."""
    scale = (CAMERA_HEIGHT - OBJECT_HEIGHT) / FOCAL_LENGTH
    x, y = (pixel[..., 0] - MIDDLE) * scale - BASELINE / 2, CAMERA_Y + (MIDDLE - pixel[..., 1]) * scale
    return np.stack([x, y, np.full_like(x, OBJECT_HEIGHT)], axis=-1)


def in_bin(positions: np.ndarray) -> np.ndarray:
    """Whether points [..., 3] are in the bin, or above it."""
    half = [BIN_OUTSIDE, BIN_OUTSIDE + BIN_FAR / 2]
    return np.all(np.abs(positions[..., :2] - [0.0, BIN_FAR / 2]) < half, axis=-1)


def place_of(position: np.ndarray) -> str:
    """Where a point [3] is: ``bin``, ``accept``, ``reject``, or ``outside`` of all of them."""
    if in_bin(position):
        return "bin"
    inside = (name for name, cup in CUPS.items() if np.all(np.abs(position[:2] - cup) < CUP_INSIDE))
    return next(inside, "outside")
