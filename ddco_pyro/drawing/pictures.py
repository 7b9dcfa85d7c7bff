"""Figures as files in the run folder and as data in the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ddco_pyro.data.files import whole_file

WIDTH = 9.6
"""Inches; with the page's width of some 960 pixels, one point in a figure is as large as one in its text."""

INK = "#222222"
FAINT = "#8a8a8a"
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


@dataclass(frozen=True)
class Picture:
    """A figure in the page: PNG as a data URI, its caption and the text that stands in for it."""

    uri: str
    alt: str
    caption: str


@contextmanager
def style() -> Iterator[None]:
    """Draw in the report's fonts and lines."""
    with matplotlib.rc_context(STYLE):
        yield


def blank(height: float) -> Figure:
    """An empty figure as wide as the page; height in inches."""
    return Figure(figsize=(WIDTH, height), layout="constrained")


def keep(figure: Figure, path: Path, alt: str, caption: str) -> Picture:
    """Write a figure as PNG and make a picture of it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, metadata={"Description": alt})
    with whole_file(path) as temporary:
        temporary.write_bytes(buffer.getvalue())
    return Picture(data_uri(buffer.getvalue(), "image/png"), alt, caption)


def data_uri(content: bytes, kind: str) -> str:
    """Content as ``data:<kind>;base64,...``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def hide_frame(axes: Axes) -> None:
    """No ticks and no frame."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
