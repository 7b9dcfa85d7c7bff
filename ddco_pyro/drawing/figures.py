"""Plots of values with intervals, and drawings as files of their own, in SVG."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.diagrams import WIDTH, svg, words_at
from ddco_pyro.drawing.page import Drawing
from ddco_pyro.metrics import Difference

INK = "var(--ink)"
FAINT = "var(--soft)"
ACCENT = "#e76300"

LOOKS = (
    "<style>svg { --ink: #222; --soft: #5c5c5c; --paper: #fff; --line: #ccc; background: #fff; font: 11px sans-serif; "
    "fill: var(--ink); } .soft { fill: var(--soft); } .faint { fill: none; stroke: var(--line); }</style>"
)
"""Of a drawing that stands alone; a page has these of its own."""

ROW, TITLE, AXIS = 26.0, 24.0, 42.0
"""Heights of a row of a plot, of what is above and of what is below."""


def save(drawing: Markup, path: Path, caption: str = "") -> Drawing:
    """Write a drawing as a file of its own; the same drawing for a page."""
    head, rest = str(drawing).removeprefix("<svg").split(">", 1)
    write_text(path, f'<svg xmlns="http://www.w3.org/2000/svg"{head}>{LOOKS}{rest}\n')
    return Drawing(drawing, caption)


def data_uri(content: bytes, kind: str) -> str:
    """Bytes as ``data:<kind>;base64,...``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its interval (NaN where unknown), the single values behind it, and its looks.

    :param hollow: a second value, drawn as a hollow circle.
    :param marker: ``o``, ``D`` (a diamond) or ``s`` (a square).
    """

    value: float
    low: float = np.nan
    high: float = np.nan
    points: Sequence[float] = ()
    hollow: float | None = None
    marker: str = "o"
    colour: str = INK

    @classmethod
    def around(cls, value: float, error: float | None, points: Sequence[float] = (), **looks: Any) -> Interval:
        """The value ± an error, which may be unknown."""
        half = np.nan if error is None else error
        return cls(value, value - half, value + half, points, **looks)

    @classmethod
    def of(cls, difference: Difference | None, points: Sequence[float] = (), **looks: Any) -> Interval | None:
        """A difference ± its standard error."""
        if difference is None:
            return None
        return cls.around(difference.nats_per_step, difference.standard_error, points, **looks)

    @property
    def numbers(self) -> list[float]:
        """All numbers that are drawn."""
        every = [self.value, self.low, self.high, *self.points, *([] if self.hollow is None else [self.hollow])]
        return [number for number in every if np.isfinite(number)]


@dataclass(frozen=True)
class Panel:
    """One panel of :func:`interval_plot`: an interval or None for each row.

    :param line: where to draw a vertical line.
    :param band: the ends of a shaded band.
    :param ends: of the axis; by default those of all numbers.
    """

    title: str
    axis: str
    rows: Sequence[Interval | None]
    line: float | None = None
    band: tuple[float, float] | None = None
    ends: tuple[float, float] = (np.inf, -np.inf)


def interval_plot(names: Sequence[str], panels: Sequence[Panel], alt: str, notes: Sequence[str] = ()) -> Markup:
    """A forest plot: a row for each name, panels side by side, and ``notes`` below, a line each."""
    left = min(12 + 6.2 * max(map(len, names)), WIDTH / 2)  # of longer names the ends are seen
    height = TITLE + ROW * len(names) + AXIS
    parts: list[str] = [
        words_at(left - 8, TITLE + ROW * (place + 0.65), name, "end") for place, name in enumerate(names)
    ]
    for number, panel in enumerate(panels):
        each = (WIDTH - left) / len(panels)
        parts += _panel(panel, left + number * each, each - 14, TITLE + ROW * len(names))
    parts += [words_at(4, height + 15 * place, text, "start", "soft") for place, text in enumerate(notes, start=1)]
    return svg(WIDTH, height + 15 * len(notes) + 4, alt, parts)


def _panel(panel: Panel, left: float, width: float, bottom: float) -> list[str]:
    """The parts of a panel, whose axis is at ``bottom``."""
    every = [number for row in panel.rows if row for number in row.numbers]
    every += [*(panel.band or ()), *([] if panel.line is None else [panel.line])]
    low, high = min(panel.ends[0], *every), max(panel.ends[1], *every)
    span = (high - low) or 1.0

    def at(value: float) -> float:
        return left + 8 + (width - 16) * (value - low) / span

    def vertical(x: float, top: float, end: float, looks: str) -> str:
        return f'<line x1="{x:.1f}" y1="{top:.1f}" x2="{x:.1f}" y2="{end:.1f}" {looks}/>'

    parts: list[str] = [words_at(left + 8, TITLE - 10, panel.title, "start")]
    if panel.band is not None:
        first, last = (at(end) for end in panel.band)
        size = f'width="{last - first:.1f}" height="{bottom - TITLE:.1f}"'
        parts.append(f'<rect x="{first:.1f}" y="{TITLE:.1f}" {size} fill="{ACCENT}" opacity="0.15"/>')
    power = 10.0 ** np.floor(np.log10(span / 5))
    step = next(power * count for count in (1, 2, 5, 10) if 5 * power * count >= span)
    for number in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step:
        parts.append(vertical(at(number), TITLE, bottom, 'class="faint"'))
        parts.append(words_at(at(number), bottom + 14, f"{number + 0.0:.10g}".replace("-", "−"), kind="soft"))
    if panel.line is not None:
        parts.append(vertical(at(panel.line), TITLE, bottom, f'stroke="{FAINT}"'))
    parts.append(words_at(left + width / 2, bottom + 30, panel.axis, kind="soft"))
    for place, row in enumerate(panel.rows):
        y = TITLE + ROW * (place + 0.5)
        for point in row.points if row else ():
            parts.append(f'<circle cx="{at(point):.1f}" cy="{y:.1f}" r="2.2" fill="{FAINT}" opacity="0.5"/>')
        if row and row.hollow is not None:
            looks = f'r="4" fill="var(--paper)" stroke="{row.colour}"'
            parts.append(f'<circle cx="{at(row.hollow):.1f}" cy="{y:.1f}" {looks}/>')
        if row and np.isfinite(row.low):
            looks = f'stroke="{row.colour}" stroke-width="1.4"'
            parts += [vertical(at(end), y - 4, y + 4, looks) for end in (row.low, row.high)]
            parts.append(f'<line x1="{at(row.low):.1f}" y1="{y:.1f}" x2="{at(row.high):.1f}" y2="{y:.1f}" {looks}/>')
        if row and np.isfinite(row.value):
            parts.append(_marker(at(row.value), y, row))
    return parts


def _marker(x: float, y: float, row: Interval) -> str:
    if row.marker == "o":
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{row.colour}"/>'
    turned = f' transform="rotate(45 {x:.1f} {y:.1f})"' if row.marker == "D" else ""
    return f'<rect x="{x - 3.6:.1f}" y="{y - 3.6:.1f}" width="7.2" height="7.2" fill="{row.colour}"{turned}/>'
