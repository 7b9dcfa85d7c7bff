"""Figures as PNG files and as data in a page; the plot of values with intervals."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ddco_pyro.data.files import whole_file
from ddco_pyro.drawing.page import Picture
from ddco_pyro.metrics import Difference

WIDTH = 9.6
"""Inches. On a page of 960 pixels, text in a figure is as large as the page's own."""

INK = "#222222"
FAINT = "#8a8a8a"
GRID = "#e4e4e4"
ACCENT = "#e76300"
DOTS_PER_INCH = 150

STYLE: Any = {  # matplotlib types the keys as literals
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "text.color": INK,
    "text.parse_math": False,  # a $ in a name is a $
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
}


@contextmanager
def style() -> Iterator[None]:
    """The fonts and lines of all figures, while the context lasts."""
    with matplotlib.rc_context(STYLE):
        yield


def save(figure: Figure, path: Path, alt: str, caption: str = "") -> Picture:
    """Write a figure as PNG; the same figure for a page."""
    buffer = io.BytesIO()
    figure.set_dpi(DOTS_PER_INCH)
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Description": alt})  # savefig draws twice
    with whole_file(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return Picture(data_uri(buffer.getvalue(), "image/png"), alt, caption)


def data_uri(content: bytes, kind: str) -> str:
    """Bytes as ``data:<kind>;base64,...``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its interval (NaN where unknown), the single values behind it, and its looks.

    :param hollow: a second value, drawn as a hollow circle.
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


@dataclass(frozen=True)
class Panel:
    """One panel of :func:`interval_plot`: an interval or None for each row.

    :param line: where to draw a vertical line.
    :param band: the ends of a shaded band.
    """

    title: str
    axis: str
    rows: Sequence[Interval | None]
    line: float | None = None
    band: tuple[float, float] | None = None


def interval_plot(names: Sequence[str], panels: Sequence[Panel], notes: Sequence[str] = ()) -> Figure:
    """A forest plot: a row for each name, panels side by side, and ``notes`` below, a line each."""
    figure = Figure(figsize=(WIDTH, 1.1 + 0.34 * len(names) + 0.17 * len(notes)), layout="constrained")
    all_axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, panel in zip(all_axes, panels, strict=True):
        if panel.line is not None:
            axes.axvline(panel.line, color=FAINT, linewidth=0.8, zorder=1)
        if panel.band is not None:
            axes.axvspan(*panel.band, color=ACCENT, alpha=0.12, linewidth=0)
        for place, row in enumerate(panel.rows):
            if row is not None:
                _interval(axes, place, row)
        axes.set(xlabel=panel.axis, title=panel.title)
        axes.grid(axis="x", color=GRID)
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
    all_axes[0].set_yticks(np.arange(len(names)), names)
    all_axes[0].set_ylim(len(names) - 0.4, -0.6)
    if notes:
        figure.supxlabel("\n".join(notes), fontsize=8, color=INK, x=0.01, ha="left")
    return figure


def _interval(axes: Axes, place: int, row: Interval) -> None:
    axes.scatter(row.points, np.full(len(row.points), place), s=13, color=FAINT, alpha=0.5, linewidth=0, zorder=2)
    if row.hollow is not None:
        axes.scatter(row.hollow, place, facecolor="white", edgecolor=row.colour, zorder=3)
    ends = None if np.isnan(row.low) else [[row.value - row.low], [row.high - row.value]]
    axes.errorbar(row.value, place, xerr=ends, fmt=row.marker, color=row.colour, capsize=4, zorder=3)
