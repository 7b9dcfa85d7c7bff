"""Which inputs matter: the branches of each level's networks, by option."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ddco_pyro.drawing.pictures import blank

SHADES = ("#1f3b73", "#6f8fc9", "#c9a227", "#8c4a32", "#5b8c5a", "#7d6b91")
"""One for each branch, in turn."""


def draw(uses: Sequence[Mapping[str, Any]], labels: Sequence[Sequence[str]]) -> Figure:
    """A row for each level: mean activation of each branch, and nats per step lost without what it reads, by option.

    :param uses: those of :func:`ddco_pyro.evaluation.branch_use.branch_use`.
    :param labels: what the rows of each are called.
    """
    figure = blank(2.6 * len(uses))
    axes = figure.subplots(len(uses), 2, squeeze=False)
    for row, (use, names) in enumerate(zip(uses, labels, strict=True)):
        width = 0.8 / len(use["branches"])
        for side, (what, title) in enumerate((("activation", "mean activation"), ("loss", "nats per step lost"))):
            panel = axes[row, side]
            for place, branch in enumerate(use["branches"]):
                heights = [value[place] if value[place] is not None else np.nan for value in use[what]]
                panel.bar(np.arange(len(names)) + place * width, heights, width, label=branch, color=_shade(place))
            panel.set_xticks(np.arange(len(names)) + 0.4 - width / 2, names)
            panel.set_ylabel(title)
            panel.axhline(0, color="#888888", linewidth=0.6)
        axes[row, 0].legend(frameon=False, fontsize="small")
    return figure


def _shade(place: int) -> str:
    return SHADES[place % len(SHADES)]
