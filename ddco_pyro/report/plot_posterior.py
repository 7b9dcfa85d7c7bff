"""The posterior u_t(h) along a few demonstrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator

from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.pictures import blank
from ddco_pyro.report.activity import Activity, LevelActivity
from ddco_pyro.report.strips import draw_labels, draw_path, legend

MOST_POINTS = 400


@dataclass(frozen=True)
class Example:
    """A demonstration to show: its row in the activity, its name, and its labels [T] by name."""

    row: int
    name: str
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)


def draw(activity: Activity, examples: Sequence[Example]) -> Figure:
    """Two demonstrations side by side; for each level u_t stacked, with the most likely path under it."""
    rows = -(-len(examples) // 2)
    labels = len(examples[0].labels)
    figure = blank(0.35 + rows * (0.55 + 1.25 * len(activity.levels) + 0.2 * labels))
    parts = figure.subfigures(rows, 2, squeeze=False)
    for part, example in zip(parts.flat, examples, strict=False):
        _example(part, activity, example)
    choices = sorted({choice for level in activity.levels for choice in level.choices})
    figure.legend(handles=legend(choices), loc="outside lower center", ncols=min(len(choices), 11), handlelength=1)
    return figure


def _example(figure: SubFigure, activity: Activity, example: Example) -> None:
    length = int(activity.lengths[example.row])
    heights = [*([5, 0.8] * len(activity.levels)), *([0.9] * len(example.labels))]
    panels = figure.subplots(len(heights), 1, height_ratios=heights, gridspec_kw={"hspace": 0.02})
    for depth, level in enumerate(reversed(activity.levels)):
        stack, strip = panels[2 * depth], panels[2 * depth + 1]
        _stack(stack, level, example.row, length)
        stack.set_ylabel(f"{level.name}\nprobability" if len(activity.levels) > 1 else "probability")
        draw_path(strip, level.path[example.row, :length])
        strip.set_ylabel("path", rotation=0, ha="right", va="center", fontsize=7.5)
    for strip, (name, labels) in zip(panels[2 * len(activity.levels) :], example.labels.items(), strict=True):
        draw_labels(strip, labels)
        strip.set_ylabel(
            "label" if len(example.labels) == 1 else name, rotation=0, ha="right", va="center", fontsize=7.5
        )
    panels[0].set_title(example.name)
    _time_axis(panels[-1], length)


def _stack(axes: Axes, level: LevelActivity, row: int, length: int) -> None:
    """u_t of every choice, stacked; steps as steps."""
    size = -(-length // MOST_POINTS)
    starts = np.arange(0, length, size)
    active = np.add.reduceat(level.active[row, :length], starts) / np.diff([*starts, length])[:, None]
    edges = np.array([*starts, length]) - 0.5
    top = np.cumsum(active, axis=1)
    for choice in range(active.shape[1]):
        lower, upper = top[:, choice] - active[:, choice], top[:, choice]
        axes.stairs(upper, edges, baseline=lower, fill=True, color=option_colour(choice), linewidth=0)
    axes.set(xlim=(-0.5, length - 0.5), ylim=(0, 1), xticks=[], yticks=[0, 0.5, 1])


def _time_axis(axes: Axes, length: int) -> None:
    axes.set_xlim(-0.5, length - 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
    axes.set_xlabel("step t", labelpad=1)
