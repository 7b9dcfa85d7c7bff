"""Options in the report: when each is active, how it is used, where it is active in space, and its segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import SubFigure
from matplotlib.ticker import MaxNLocator

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import add_legend, is_bright, option_colour
from ddco_pyro.drawing.figures import FAINT, INK, blank, hide_frame, save
from ddco_pyro.drawing.page import Block, Cell, Picture, Section, Table, Text, note
from ddco_pyro.drawing.timeline import Timelines
from ddco_pyro.drawing.words import duration, number, percent
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import NamedByLabel
from ddco_pyro.names import label_name, numbered_name
from ddco_pyro.report import trajectories
from ddco_pyro.report.trajectories import Activity
from ddco_pyro.segmenting.page import HOW
from ddco_pyro.spec import PathSpec

EXAMPLES = 4
"""Demonstrations whose posterior is shown step by step."""

MOST_POINTS = 400
"""Steps that are drawn of a posterior; longer demonstrations are averaged over groups of steps."""

ROWS = 6
"""Time lines that are seen at once."""

MOST_STEPS = 1_000_000
"""Steps of all levels in time lines, about; ``ddco-pyro segment --html`` makes a page of more."""

CHARACTER = 0.016
"""The share of a posterior's width that a character of a label takes, about."""

LABEL_SHADES = ("#ffffff", "#d4d4d4")
"""Shades of segments whose label is matched with no option, in turn."""


def section(fit: Fit, demos: Demonstrations, activity: Activity, paths: Sequence[PathSpec]) -> Section:
    """When each option is active, how it is used, and the paths in space."""
    labels = [
        {name: demo.labels[name] for name in fit.spec.demonstrations.label_names if name in demo.labels}
        for demo in demos
    ]
    pictures = (
        _posterior_picture(fit, demos, activity, labels),
        trajectories.picture(fit, demos, activity, paths),
    )
    used = note("On the most likely path of all demonstrations. The same option chosen anew stays one segment.")
    blocks: list[Block] = [picture for picture in pictures if picture is not None]
    if len(fit.names) > 1:
        named = " Legends give the names of the highest level first." if fit.named else ""
        apart = f"Each level numbers its own options: equal colours in two levels mean nothing.{named}"
        blocks.insert(0, Text(apart))
    blocks.append(Text("Use of the options", "heading"))
    blocks.append(use_table(fit))
    link = Markup('<a href="#segments">segments of every demonstration</a>')
    blocks += [used, Text(Markup("Step by step: {}.").format(link))]
    return Section("options", "Which option is active when", blocks, folded=True)


def use_table(fit: Fit) -> Table:
    """The use of each choice of each level, the highest level first; control only where it is chosen."""
    rows, stands_for = [], {(one.level, one.option): agreeing(one) for one in fit.metrics.named_by_labels}
    for (level, names), use in reversed(list(zip(fit.names.items(), fit.metrics.options, strict=True))):
        total = sum(row.steps for row in use)
        for row in use:
            if row.choice or row.segments:
                named = Cell(numbered_name(row.choice, names), colour=option_colour(row.choice))
                length = "–" if row.length is None else duration(fit.metrics.control_frequency, row.length)
                label = [stands_for.get((level, row.choice), "–")] if stands_for else []
                rows.append([level, named, percent(row.steps / total, 1), str(row.segments), length, *label])
    head = ["Level", "Option", "Share of steps", "Segments", "Median length"]
    return Table([*head, *(["Label, agreement"] if stands_for else [])], rows, {0, 1, 5})


def agreeing(one: NamedByLabel) -> str:
    """The label that an option stands for, with their agreement: ``reach 0.71``."""
    return f"{one.name} {number(one.agreement)}"


def quoted(names: Mapping[str, Any] | Sequence[str]) -> str:
    """``label “phase” and “grasp”``."""
    return "label " + " and ".join(f"“{name}”" for name in names)


# --- the posterior along a few demonstrations -------------------------------------------------------------------------


def _posterior_picture(
    fit: Fit, demos: Demonstrations, activity: Activity, labels: Sequence[Mapping[str, np.ndarray]]
) -> Picture:
    """Two demonstrations side by side: for each level u_t, stacked, over the most likely path."""
    held_out = [demo.name for demo in fit.metrics.valid if demo.name in demos.names]
    names = (held_out or list(demos.names))[:EXAMPLES]
    examples = {name: demos.names.index(name) for name in names}
    caption = (
        f"Posterior probability of each option at each step of {len(names)} {'held-out ' if held_out else ''}"
        "demonstrations (u in the paper), stacked. Path: the most likely sequence of options."
    )
    if known := labels[examples[names[0]]]:
        caption += f" Boxes: ground-truth {quoted(known)}, in the colour of the option that a label is matched with."
    rows = -(-len(examples) // 2)
    figure = blank(0.35 + rows * (0.55 + 1.25 * len(activity.levels) + 0.2 * len(known)))
    for part, (name, row) in zip(figure.subfigures(rows, 2, squeeze=False).flat, examples.items(), strict=False):
        _example(part, activity, row, labels[row])
        part.axes[0].set_title(name)
    add_legend(figure, activity.choices, activity.names)
    alt = f"Stacked probabilities of the options over time in {', '.join(names)}"
    return save(figure, fit.run_folder / "figures" / "posterior.png", alt, caption)


def _example(figure: SubFigure, activity: Activity, row: int, labels: Mapping[str, np.ndarray]) -> None:
    length, known = int(activity.lengths[row]), activity.segmented.label_names
    heights = [*([5, 0.8] * len(activity.levels)), *([0.9] * len(labels))]
    panels = iter(figure.subplots(len(heights), 1, height_ratios=heights, gridspec_kw={"hspace": 0.02}))
    beside: dict[str, Any] = {"rotation": 0, "ha": "right", "va": "center", "fontsize": 7.5}
    for level in reversed(activity.levels):
        stack, strip = next(panels), next(panels)
        size = -(-length // MOST_POINTS)
        starts = np.arange(0, length, size)
        active = np.add.reduceat(level.active[row, :length], starts) / np.diff([*starts, length])[:, None]
        _stack(stack, active, np.array([*starts, length]) - 0.5)
        stack.set(xticks=[], yticks=[0, 0.5, 1])
        stack.set_ylabel(f"{level.name}\nprobability" if len(activity.levels) > 1 else "probability")
        path, extent = level.path[row : row + 1, :length], (-0.5, length - 0.5, 0, 1)
        strip.imshow(colour_image(path), aspect="auto", interpolation="nearest", extent=extent)
        hide_frame(strip)
        strip.set_ylabel("path", **beside)
    for strip, (name, values) in zip(panels, labels.items(), strict=True):
        text = [label_name(name, value, known.get(name, ())) for value in values.tolist()]
        _labels(strip, values, text, activity.segmented.label_colours(name))
        strip.set_ylabel("label" if len(labels) == 1 else name, **beside)
    last = figure.axes[-1]
    last.set_xlim(-0.5, length - 0.5)
    last.xaxis.set_major_locator(MaxNLocator(7, integer=True))
    last.set_xlabel("step t", labelpad=1)


def _stack(axes: Axes, shares: np.ndarray, edges: np.ndarray) -> None:
    """Shares of choices [B, C] stacked over bins with these edges [B + 1]."""
    top = np.cumsum(shares, axis=1)
    for choice in range(shares.shape[1]):
        lower = top[:, choice] - shares[:, choice]
        axes.stairs(top[:, choice], edges, baseline=lower, fill=True, color=option_colour(choice), linewidth=0)
    axes.set(xlim=(edges[0], edges[-1]), ylim=(0, 1))


def _labels(axes: Axes, labels: np.ndarray, names: Sequence[str], colours: Mapping[int, str]) -> None:
    """One demonstration's labels [T] as boxes, with their names where there is room."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(labels)) + 1, [len(labels)]])
    for place, (start, end) in enumerate(pairwise(edges.tolist())):
        colour = colours.get(int(labels[start]), LABEL_SHADES[place % 2])
        axes.axvspan(start - 0.5, end - 0.5, facecolor=colour, edgecolor=FAINT, linewidth=0.5)
        if end - start > CHARACTER * len(names[start]) * len(labels):
            ink = INK if is_bright(colour) else "white"
            middle = (start + end - 1) / 2
            axes.text(middle, 0.45, names[start], ha="center", va="center", fontsize=7.5, color=ink)
    axes.set_xlim(-0.5, len(labels) - 0.5)
    hide_frame(axes)


def colour_image(path: np.ndarray) -> np.ndarray:
    """Choices [N, T] as colours [N, T, 3]."""
    palette = np.array([to_rgb(option_colour(choice)) for choice in range(int(path.max()) + 1)])
    image: np.ndarray = palette[path]
    return image


# --- segments ---------------------------------------------------------------------------------------------------------


def segments(drawn: Timelines, demonstrations: int) -> Section:
    """The time lines; a note on the others where not all of so many demonstrations have one."""
    explained = Markup('{} The order is that of the <a href="#demonstrations">list</a>.').format(HOW)
    blocks: list[Block] = [note(explained), replace(drawn, rows=ROWS)]
    if len(drawn.tracks) < demonstrations:
        command = Markup("<code>ddco-pyro segment RUN FILE --html PAGE</code>")
        blocks.append(note(Markup("The others would make this page slow; {} makes a page of them.").format(command)))
    return Section("segments", "Segments of every demonstration", blocks)
