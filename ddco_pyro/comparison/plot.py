"""A comparison as a figure, in the form of arviz's ``plot_compare``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ddco_pyro.comparison.table import Comparison, Row
from ddco_pyro.drawing.pictures import FAINT, INK, Picture, blank, keep, style


def write(compared: Comparison, path: Path) -> Picture:
    """Draw the comparison as PNG."""
    with style():
        alt = "; ".join(f"{row.name}: {row.total:.1f} nats held out" for row in compared.rows)
        caption = (
            f"Held-out log-likelihood of {len(compared.trajectories)} trajectories, ± one standard error (dots); "
            "below each but the best, its difference to the best, ± one standard error of the paired difference "
            "(triangles). The dashed line is the best's."
        )
        return keep(draw(compared.rows), path, alt, caption)


def draw(rows: Sequence[Row]) -> Figure:
    """Totals with their errors, and below them the paired differences, drawn from the best's total."""
    figure = blank(1.0 + 0.5 * len(rows))
    axes = figure.subplots()
    places = np.arange(len(rows), dtype=float)
    axes.axvline(rows[0].total, color=FAINT, linewidth=0.8, linestyle="--")
    axes.errorbar(
        [row.total for row in rows], places, xerr=[_shown(row.se) for row in rows], fmt="o", color=INK, capsize=4,
        label="total ± se",
    )  # fmt: skip
    axes.errorbar(
        [rows[0].total - row.difference for row in rows[1:]], places[1:] + 0.3,
        xerr=[_shown(row.dse) for row in rows[1:]], fmt="^", color="#e76300", capsize=4, label="difference ± dse",
    )  # fmt: skip
    axes.set_yticks(places, [row.name for row in rows])
    axes.set_ylim(len(rows) - 0.3, -0.6)
    axes.set(xlabel="held-out log-likelihood (nats)")
    axes.grid(axis="x", color="#e4e4e4")
    axes.legend(loc="upper left", bbox_to_anchor=(0, 1.0 + 0.35 / len(rows)), ncols=2, borderaxespad=0)
    return figure


def _shown(error: float) -> float:
    return 0.0 if np.isnan(error) else error
