"""Choices over time as strips of colour, ground truth as boxes of text."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.pictures import FAINT, hide_frame
from ddco_pyro.drawing.words import option_name

LABEL_SHADES = ("#ffffff", "#d4d4d4")
"""Ground truth has no colours: those belong to options. Its segments alternate in shade and carry their label."""


def colour_image(path: np.ndarray) -> np.ndarray:
    """Choices [N, T] as colours [N, T, 3]; white where there is none (-1)."""
    palette = np.array([to_rgb(option_colour(choice)) for choice in range(max(int(path.max()), 0) + 1)] + [(1, 1, 1)])
    image: np.ndarray = palette[path]  # -1 is the last entry
    return image


def label_image(labels: Sequence[np.ndarray], steps: int) -> np.ndarray:
    """Labels [T_n] of N demonstrations as shades of grey [N, steps, 3]; white past the end."""
    values = sorted({int(value) for array in labels for value in np.unique(array)})
    shades = np.linspace(0.86, 0.1, len(values))
    image = np.ones((len(labels), steps, 3))
    for row, array in zip(image, labels, strict=True):
        row[: len(array)] = shades[np.searchsorted(values, array), None]
    return image


def draw_path(axes: Axes, path: np.ndarray) -> None:
    """One demonstration's choices [T] as a strip."""
    axes.imshow(colour_image(path[None]), aspect="auto", interpolation="nearest", extent=(-0.5, len(path) - 0.5, 0, 1))
    hide_frame(axes)


def draw_labels(axes: Axes, labels: np.ndarray) -> None:
    """One demonstration's labels [T] as boxes, each with its label where there is room."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(labels)) + 1, [len(labels)]])
    for number, (start, end) in enumerate(pairwise(edges.tolist())):
        shade = LABEL_SHADES[number % 2]
        axes.axvspan(start - 0.5, end - 0.5, facecolor=shade, edgecolor=FAINT, linewidth=0.5)
        if end - start > 0.03 * len(labels):
            axes.text((start + end - 1) / 2, 0.45, str(labels[start]), ha="center", va="center", fontsize=7.5)
    axes.set_xlim(-0.5, len(labels) - 0.5)
    hide_frame(axes)


def legend(choices: Sequence[int]) -> list[Patch]:
    """Handles that name the colours of choices."""
    return [Patch(color=option_colour(choice), label=option_name(choice)) for choice in choices]
