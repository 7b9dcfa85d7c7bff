"""What the left eye sees of a load where loads are shown, in numbers: usual descriptors of a mask's shape."""

from __future__ import annotations

import cv2
import numpy as np

from .geometry import SHOWING, project

# pixels about the place where loads are shown; the rows begin at the picture's edge
HALF_HEIGHT, HALF_WIDTH = 52, 112
COLUMN, ROW = np.round(project(SHOWING)).astype(int)
ROWS = slice(max(0, ROW - HALF_HEIGHT), ROW + HALF_HEIGHT)
REGION = (ROWS, slice(COLUMN - HALF_WIDTH, COLUMN + HALF_WIDTH))
FEWEST = 4  # pixels; fewer have no shape
NAMES = (
    "area", "inside", "parts", "largest part", "spread across", "spread along", "hull", "length", "width",
    "outline", "solidity", "column", "row", "left", "right", "top", "bottom", "slant",
)  # fmt: skip
"""Of the numbers of :func:`described`."""


def load_of(left: np.ndarray) -> np.ndarray:
    """Numbers [18] of :func:`described` of what a left eye's mask, uint8 [288, 288], shows of a load."""
    return described(left[REGION])


def described(mask: np.ndarray) -> np.ndarray:
    """The shape of what is not 0 in a mask uint8 [H, W]: numbers [18] in pixels (:data:`NAMES`), 0 for few.

    Its pixels, those that have neighbours above, to the left and between, how many parts it has, and the
    pixels of the largest; standard deviations along its principal axes; the area of its convex hull, the
    sides of the smallest rectangle about it and the length of its outlines; its pixels over the hull's area;
    centre, extent, and the sine of the angle between its longer principal axis and the rows.
    """
    rows, columns = np.nonzero(mask)
    if len(rows) < FEWEST:
        return np.zeros(len(NAMES))
    seen = (mask > 0).astype(np.uint8)
    pixels = np.stack([columns, rows], axis=1)
    variances, axes = np.linalg.eigh(np.cov(pixels.T))
    parts, _, measured, _ = cv2.connectedComponentsWithStats(seen, connectivity=8)
    hull = cv2.contourArea(cv2.convexHull(pixels.astype(np.int32)))
    sides = cv2.minAreaRect(pixels.astype(np.int32))[1]
    outlines = cv2.findContours(seen, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    return np.array(
        [
            len(rows),
            cv2.erode(seen, np.ones((2, 2), np.uint8)).sum(),
            parts - 1,
            measured[1:, cv2.CC_STAT_AREA].max(),
            *np.sqrt(np.maximum(variances, 0.0)),
            hull,
            max(sides),
            min(sides),
            sum(cv2.arcLength(outline, closed=True) for outline in outlines),
            len(rows) / (hull + 1.0),
            *pixels.mean(axis=0),
            columns.min(),
            columns.max(),
            rows.min(),
            rows.max(),
            abs(axes[1, 1]),
        ]
    )
