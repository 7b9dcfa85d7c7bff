"""The needle's ellipse in an overhead image: colour segmentation, convex hull, least-squares ellipse."""

from __future__ import annotations

import cv2
import numpy as np

CAMERA_HEIGHT = 650.0  # mm above the mat
FIELD_OF_VIEW = np.deg2rad(11.0)  # vertical
IMAGE_SIZE = 480  # pixels, square
NEEDLE_RADIUS = 0.5  # mm: the height of a lying needle's axis
MM_PER_PIXEL = 2.0 * (CAMERA_HEIGHT - NEEDLE_RADIUS) * np.tan(FIELD_OF_VIEW / 2.0) / IMAGE_SIZE
GREEN_LOW = (45, 110, 70)  # OpenCV's HSV: hue 0-180, saturation and value 0-255
GREEN_HIGH = (85, 255, 255)
MIN_PIXELS = 30  # fewer say too little about the needle's direction


def segment(image: np.ndarray) -> np.ndarray:
    """Mask, uint8 [H, W] with 255 on the needle, of an RGB image uint8 [H, W, 3]."""
    return cv2.inRange(cv2.cvtColor(image, cv2.COLOR_RGB2HSV), GREEN_LOW, GREEN_HIGH)


def ellipse(image: np.ndarray) -> np.ndarray | None:
    """The needle's ellipse [6], or None where too little of the needle is seen.

    The centre x, y and the lengths of the major and minor axes (mm, at the height of the mat), then the
    cosine and sine of twice the major axis' angle, which do not jump where the angle wraps. The ellipse goes
    through the outline of the mask's convex hull: an ellipse through the pixels themselves would follow the
    needle's curve to a whole circle, which has no principal axis.
    """
    mask = segment(image)
    pixels = cv2.findNonZero(mask)
    if pixels is None or len(pixels) < MIN_PIXELS:
        return None
    hull = cv2.fillConvexPoly(np.zeros_like(mask), cv2.convexHull(pixels), 255)
    outlines, _ = cv2.findContours(hull, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    (column, row), (width, height), angle = cv2.fitEllipse(outlines[0])
    middle = (IMAGE_SIZE - 1) / 2.0
    # OpenCV's angle turns the first axis clockwise in the image; rows grow towards -y.
    direction = -np.deg2rad(angle if width >= height else angle + 90.0)
    return np.array(
        [
            (column - middle) * MM_PER_PIXEL,
            (middle - row) * MM_PER_PIXEL,
            max(width, height) * MM_PER_PIXEL,
            min(width, height) * MM_PER_PIXEL,
            np.cos(2.0 * direction),
            np.sin(2.0 * direction),
        ]
    )


def principal_angle(features: np.ndarray, near: float) -> float:
    """The direction (rad) of the ellipse's major axis that is nearest to ``near``; features [6] as above."""
    angle = 0.5 * np.arctan2(features[5], features[4])
    return float(angle + np.pi * np.round((near - angle) / np.pi))
