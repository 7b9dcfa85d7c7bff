"""Grasp candidates in a mask: points on what is seen, each with a direction, and a classifier of them.

The classifier is a logistic regression over how the mask looks in the frame of the gripper, so its weights
are a few numbers. ``grasp_classifier.json`` holds them; ``studies/bin_picking_candidates.py`` of commit
6b4a34a made it from 40 labelled images.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from .geometry import CAMERA_HEIGHT, FOCAL_LENGTH, nearest_turn

WEIGHTS = Path(__file__).parent / "grasp_classifier.json"
DRAWN = 24  # points of the mask, of which one in the better half is taken
FEWEST_PIXELS = 20  # of objects; fewer are not seen
AXIS_RADIUS = 10  # pixels about a point that say in which direction the wire runs there
CENTRE_RADIUS = 4  # pixels about a point whose centre is taken for the wire's axis
PIXELS_PER_METRE = FOCAL_LENGTH / CAMERA_HEIGHT

# The patch that is looked at: cells of half a millimetre across the jaws and along the wire, averaged over
# both mirror images (the jaws are symmetric) and over blocks of cells.
CELL = 0.0005
ACROSS, ALONG = 20, 12
BLOCK = 2


@dataclass(frozen=True)
class Candidate:
    """A grasp in the left mask: a pixel [2] (column, row) and the gripper's turn about the vertical (rad)."""

    pixel: np.ndarray
    turn: float


def draw(mask: np.ndarray, random: np.random.RandomState, count: int = DRAWN) -> list[Candidate]:
    """Points drawn on a mask uint8 [H, W], moved to the axis of the wire; none where too little is seen."""
    rows, columns = np.nonzero(mask)
    if len(rows) < FEWEST_PIXELS:
        return []
    pixels = np.stack([columns, rows], axis=1).astype(float)
    return [_on_axis(pixels, pixels[number]) for number in random.randint(len(pixels), size=count)]


def _on_axis(pixels: np.ndarray, drawn: np.ndarray) -> Candidate:
    distance = np.linalg.norm(pixels - drawn, axis=1)
    around = pixels[distance <= AXIS_RADIUS]
    offsets = (around - around.mean(axis=0)) * [1.0, -1.0]  # rows grow towards -y
    values, vectors = np.linalg.eigh(offsets.T @ offsets)
    wire = vectors[:, np.argmax(values)]
    turn = nearest_turn(float(np.arctan2(wire[1], wire[0])) - np.pi / 2)
    return Candidate(pixels[distance <= CENTRE_RADIUS].mean(axis=0), turn)


def features(mask: np.ndarray, candidate: Candidate) -> np.ndarray:
    """How much of each block of the gripper's patch is covered, [ACROSS · ALONG / 4 / BLOCK²], 0 to 1."""
    across = CELL * (np.arange(ACROSS) - (ACROSS - 1) / 2)
    along = CELL * (np.arange(ALONG) - (ALONG - 1) / 2)
    side, length = np.meshgrid(across, along)
    cosine, sine = np.cos(candidate.turn), np.sin(candidate.turn)
    columns = candidate.pixel[0] + PIXELS_PER_METRE * (side * cosine - length * sine)
    rows = candidate.pixel[1] - PIXELS_PER_METRE * (side * sine + length * cosine)
    patch = cv2.remap(mask, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR) / 255.0
    folded = (patch + patch[::-1] + patch[:, ::-1] + patch[::-1, ::-1])[: ALONG // 2, : ACROSS // 2] / 4.0
    blocks = folded.reshape(ALONG // 2 // BLOCK, BLOCK, ACROSS // 2 // BLOCK, BLOCK).mean(axis=(1, 3))
    return np.asarray(blocks.ravel())


@dataclass(frozen=True)
class Classifier:
    """A logistic regression: ``weights`` [F] and ``intercept``."""

    weights: np.ndarray
    intercept: float

    @classmethod
    @cache
    def load(cls) -> Classifier:
        """The one that comes with the task."""
        kept = json.loads(WEIGHTS.read_text(encoding="utf-8"))
        return cls(np.array(kept["weights"]), float(kept["intercept"]))

    def scores(self, mask: np.ndarray, candidates: list[Candidate]) -> np.ndarray:
        """The probability [N] that each grasp takes something."""
        inputs = np.array([features(mask, candidate) for candidate in candidates])
        return np.asarray(1.0 / (1.0 + np.exp(-(inputs @ self.weights + self.intercept))))


def sample(mask: np.ndarray, random: np.random.RandomState) -> Candidate | None:
    """One of the better half of points drawn on a mask uint8 [H, W]; None where nothing is seen."""
    drawn = draw(mask, random)
    if not drawn:
        return None
    ranked = np.argsort(-Classifier.load().scores(mask, drawn), kind="stable")
    return drawn[ranked[random.randint(len(drawn) // 2)]]
