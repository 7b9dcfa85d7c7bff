"""Geometry of the pushing task in its plane (x, z): the arm's kinematics, and what is clear of the box.

Angles are those of the model: all 0 is an arm that hangs straight down, positive ones turn what hangs towards
+x. The *pitch* of the hand is the sum of the three.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

LINKS = (0.5, 0.5, 0.3)  # m: the paper's 5, 5 and 3 units
BASE_HEIGHT = 0.95  # m
RADIUS = 0.03  # m, of the links
JOINT_RANGES = np.array([[-2.6, 2.6], [0.05, 2.8], [-2.6, 2.6]])  # rad; the elbow bends one way
MAX_SPEED = 3.0  # rad/s, of each joint

BOX_HALF_WIDTH = 0.08  # m
BOX_HEIGHT = 0.25  # m
CONTACT = BOX_HALF_WIDTH + RADIUS  # m: from the box's centre to a tip that touches its side

# How far from the shoulder the wrist can be, nearest and farthest, with the elbow a little within its range.
_REACH = tuple(
    math.sqrt(LINKS[0] ** 2 + LINKS[1] ** 2 + 2 * LINKS[0] * LINKS[1] * math.cos(elbow))
    for elbow in JOINT_RANGES[1, ::-1] + [-0.01, 0.01]
)

Point = tuple[float, float]


def joints_positions(angles: np.ndarray) -> list[Point]:
    """Shoulder, elbow, wrist and tip, each (x, z) in m, at joint angles [3]."""
    x, z, total = 0.0, BASE_HEIGHT, 0.0
    points = [(x, z)]
    for length, angle in zip(LINKS, angles, strict=True):
        total += float(angle)
        x, z = x + length * math.sin(total), z - length * math.cos(total)
        points.append((x, z))
    return points


def tip_position(angles: np.ndarray) -> np.ndarray:
    """The tip's (x, z) in m at joint angles [3]."""
    return np.array(joints_positions(angles)[-1])


def inverse(tip: np.ndarray, pitch: float) -> np.ndarray:
    """Joint angles [3] that bring the tip to (x, z) with the hand at ``pitch``.

    Where that is out of reach, those of the nearest wrist position within it: the hand keeps its pitch, and
    the tip comes as near along the line from the shoulder as it can.
    """
    wrist_x = float(tip[0]) - LINKS[2] * math.sin(pitch)
    wrist_down = BASE_HEIGHT - (float(tip[1]) + LINKS[2] * math.cos(pitch))
    distance = min(max(math.hypot(wrist_x, wrist_down), _REACH[0]), _REACH[1])
    bend = (distance**2 - LINKS[0] ** 2 - LINKS[1] ** 2) / (2 * LINKS[0] * LINKS[1])
    elbow = math.acos(min(max(bend, -1.0), 1.0))
    lead = math.atan2(LINKS[1] * math.sin(elbow), LINKS[0] + LINKS[1] * math.cos(elbow))
    shoulder = math.atan2(wrist_x, wrist_down) - lead
    return np.array([shoulder, elbow, pitch - shoulder - elbow])


def is_clear(angles: np.ndarray, box_x: float, margin: float) -> bool:
    """Whether an arm at these angles is ``margin`` (m) off an upright box at ``box_x``, and off surfaces."""
    points = joints_positions(angles)
    if min(z for _, z in points[1:]) < RADIUS:
        return False
    half, top = CONTACT + margin, BOX_HEIGHT + RADIUS + margin
    moved = [(point[0] - box_x, point[1]) for point in points]
    return not any(_meets(a, b, half, top) for a, b in itertools.pairwise(moved))


def _meets(a: Point, b: Point, half: float, top: float) -> bool:
    """Whether the segment from a to b meets the rectangle |x| < half, z < top, clipped at each side."""
    enter, leave = 0.0, 1.0
    for start, change in ((half - a[0], a[0] - b[0]), (half + a[0], b[0] - a[0]), (top - a[1], a[1] - b[1])):
        if change == 0.0:
            if start <= 0.0:
                return False
        elif change > 0.0:
            enter = max(enter, -start / change)
        else:
            leave = min(leave, -start / change)
        if enter >= leave:
            return False
    return True
