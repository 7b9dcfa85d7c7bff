"""What the overhead stereo pair sees of the objects: binary masks by colour segmentation."""

from __future__ import annotations

import cv2
import numpy as np

from .. import vision
from ..rendering import mujoco, render
from .geometry import BASELINE, CAMERA_HEIGHT, FOCAL_LENGTH, IMAGE_SIZE

EYES = ("left_eye", "right_eye")
OBSERVED_SIZE = 72  # pixels by side of the masks that are observed: 1.1 mm each
COVERED = 0.3  # of a pixel of those, from which on it counts as covered
DISPARITY = round(FOCAL_LENGTH * BASELINE / CAMERA_HEIGHT)  # pixels, at the bin's floor
SEARCH, WINDOW = 4, 12  # pixels about that disparity that are tried, and half the side of what is matched


def masks(physics: mujoco.Physics) -> np.ndarray:
    """Masks, uint8 [288, 288, 2] with 255 on objects, of the left and the right eye."""
    seen = [vision.segment(render(physics, eye, IMAGE_SIZE, IMAGE_SIZE)) for eye in EYES]
    return np.stack(seen, axis=-1)


def observed(whole: np.ndarray) -> np.ndarray:
    """Both masks as they are observed, uint8 [72, 72, 2], of whole ones [288, 288, 2]."""
    covered = cv2.resize(whole, (OBSERVED_SIZE, OBSERVED_SIZE), interpolation=cv2.INTER_AREA)
    return np.where(covered > 255 * COVERED, 255, 0).astype(np.uint8)


def matched(whole: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """The pixel [2] of the right eye that shows what is at ``pixel`` [2] of the left one, on the same row."""
    column, row = np.round(pixel).astype(int)
    padded = np.pad(whole, ((WINDOW, WINDOW), (WINDOW + DISPARITY + SEARCH,) * 2, (0, 0)))
    rows = slice(row, row + 2 * WINDOW + 1)
    left = column + DISPARITY + SEARCH
    template = padded[rows, left : left + 2 * WINDOW + 1, 0]
    strip = padded[rows, left - DISPARITY - SEARCH : left - DISPARITY + SEARCH + 2 * WINDOW + 1, 1]
    best = int(np.argmin(cv2.matchTemplate(strip, template, cv2.TM_SQDIFF)))
    return np.array([pixel[0] - DISPARITY - SEARCH + best, pixel[1]])
