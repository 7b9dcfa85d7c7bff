"""The segments of demonstrations as strips on an HTML page: ``timeline.html.j2`` draws what is prepared here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from urllib.parse import quote

import matplotlib
import numpy as np

from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.words import option_name
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments

SHADES = ("#f2f2f2", "#d4d4d4")
"""Labels that were there before have no colours: those belong to options. Their segments alternate in shade."""

ROOM = 0.03
"""A segment is written upon if it takes more than this part of the longest demonstration."""


@dataclass(frozen=True)
class Box:
    """One segment on the page: where it lies, in percent of the longest demonstration, and what it says."""

    left: str
    width: str
    colour: str
    ink: str
    text: str
    title: str


@dataclass(frozen=True)
class Row:
    """One strip of a timeline: a level, or labels that were there before."""

    name: str
    boxes: tuple[Box, ...]


@dataclass(frozen=True)
class Timeline:
    """One demonstration: the ``anchor`` of its place on the page, how long it is, its log-likelihood per step, whether
    it was held out, and its strips, the highest level first.
    """

    name: str
    anchor: str
    steps: str
    log_likelihood: float
    held_out: bool
    rows: tuple[Row, ...]


def anchor(name: str) -> str:
    """The ``id`` of a demonstration's timeline, the same on every page; it can stand in an address as it is."""
    return "segments-" + quote(name, safe="").replace("%", ".")


def timelines(segmented: Segmented, most_boxes: float = math.inf) -> list[Timeline]:
    """The first demonstrations on one scale: about ``most_boxes`` segments in all, one demonstration at least."""
    shown = list(_first(segmented, most_boxes))
    longest = max(len(demo) for demo in shown)
    return [
        Timeline(
            demo.name, anchor(demo.name), duration(len(demo), segmented.frequency), demo.log_likelihood, demo.held_out,
            tuple(_rows(demo, segmented, longest)),
        )
        for demo in shown
    ]  # fmt: skip


def _first(segmented: Segmented, most_boxes: float) -> Iterator[Segments]:
    boxes = 0
    for demo in segmented.segments:
        if boxes >= most_boxes:
            return
        boxes += sum(int(level.boundaries.sum()) for level in demo.levels.values())
        yield demo


def duration(steps: float, frequency: float | None) -> str:
    """``61 steps``, and how many seconds that is where the frequency (Hz) is known."""
    return f"{steps:g} steps" + (f", {steps / frequency:.3g} s" if frequency else "")


def _rows(demo: Segments, segmented: Segmented, longest: int) -> Iterator[Row]:
    for name, level in reversed(demo.levels.items()):
        labels = segmented.option_labels.get(name, {})
        yield Row(name, tuple(_option_box(level, run, labels, segmented.frequency, longest) for run in level.runs()))
    for name, values in demo.labels.items():
        if name not in demo.levels and not name.endswith("_boundary"):
            yield Row(name, tuple(_label_boxes(name, values, longest)))


def _option_box(
    level: LevelLabels, run: tuple[int, int, int], labels: Mapping[int, int], frequency: float | None, longest: int
) -> Box:
    option, start, end = run
    mean = float(level.probability[start:end].mean())
    when = f" ({start / frequency:.3g} to {end / frequency:.3g} s)" if frequency else ""
    title = f"{option_name(option, labels)}, steps {start} to {end - 1}{when}, probability {mean:.2f}"
    return _box(start, end, longest, option_colour(option), str(option) if option else "", title)


def _label_boxes(name: str, values: np.ndarray, longest: int) -> Iterator[Box]:
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    for number, (start, end) in enumerate(pairwise(edges)):
        value = str(values[start])
        yield _box(start, end, longest, SHADES[number % 2], value, f"{name} {value}, steps {start} to {end - 1}")


def _box(start: int, end: int, longest: int, colour: str, text: str, title: str) -> Box:
    shown = text if end - start > ROOM * longest else ""
    left, width = f"{100 * start / longest:.3f}", f"{100 * (end - start) / longest:.3f}"
    return Box(left, width, colour, _ink(colour), shown, title)


def _ink(colour: str) -> str:
    """Black or white, whichever can be read on this colour."""
    red, green, blue = matplotlib.colors.to_rgb(colour)
    return "#000" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "#fff"
