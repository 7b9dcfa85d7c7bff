"""The most likely options of every demonstration, one row of colour for each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ddco_pyro.drawing.pictures import blank
from ddco_pyro.report.activity import Activity
from ddco_pyro.report.strips import colour_image, label_image, legend


def order(activity: Activity) -> np.ndarray:
    """Rows by length, then by when the option of the lowest level first changes."""
    path = activity.levels[0].path
    changed = np.diff(path, axis=1, append=-1) != 0  # at the end at the latest
    first = np.where(changed[:, :-1].any(1), changed.argmax(1), path.shape[1])
    return np.lexsort((first, activity.lengths))


def draw(activity: Activity, labels: Mapping[str, Sequence[np.ndarray]]) -> Figure:
    """A panel for each level, the highest first, and for each of the labels, by name."""
    rows = order(activity)
    images = [(f"level “{level.name}”", colour_image(level.path[rows])) for level in reversed(activity.levels)]
    for name, own in labels.items():
        title = "ground-truth labels" if len(labels) == 1 else f"labels “{name}”"
        images.append((title, label_image([own[row] for row in rows], activity.lengths.max())))
    figure = blank(float(np.clip(0.9 + 0.045 * len(rows), 2.2, 7)))
    panels = figure.subplots(1, len(images), sharey=True, squeeze=False)[0]
    for axes, (title, image) in zip(panels, images, strict=True):
        axes.imshow(
            image, aspect="auto", interpolation="nearest", extent=(-0.5, image.shape[1] - 0.5, len(rows) + 0.5, 0.5)
        )
        axes.set(title=title, xlabel="step t")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    panels[0].set_ylabel("demonstration")
    choices = sorted({choice for level in activity.levels for choice in level.choices})
    figure.legend(handles=legend(choices), loc="outside lower center", ncols=min(len(choices), 11), handlelength=1)
    return figure
