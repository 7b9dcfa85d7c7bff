"""Success rates with their intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ddco_pyro.drawing.pictures import INK, blank
from ddco_pyro.drawing.words import method


def draw(rates: Mapping[str, Mapping[str, Any]]) -> Figure:
    """The success rate of each method in percent and its 95 % interval."""
    figure = blank(0.9 + 0.32 * len(rates))
    axes = figure.subplots()
    for place, rate in enumerate(rates.values()):
        low, high = (100 * end for end in rate["interval"])
        axes.plot([low, high], [place, place], color=INK, linewidth=1.6, solid_capstyle="butt")
        axes.scatter(100 * rate["rate"], place, color=INK, zorder=3)
    axes.set_yticks(np.arange(len(rates)), [method(name) for name in rates])
    axes.set(xlim=(-1, 101), ylim=(len(rates) - 0.5, -0.5), xlabel="success rate (%), 95 % interval")
    axes.grid(axis="x", color="#e4e4e4")
    return figure
