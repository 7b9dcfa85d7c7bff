"""The result of a selection as a figure."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ddco_pyro.drawing.pictures import FAINT, INK, blank, keep, style
from ddco_pyro.selection.choice import Choice, Row

CHOSEN = "#e76300"
STATUS = {"scored": "", "failed": " (failed)", "stopped": " (stopped)"}


def write(choice: Choice, path: Path) -> None:
    """Draw the choice as PNG; nothing where no candidate was scored at all."""
    if any(row.mean is not None for row in choice.rows):
        with style():
            alt = "Held-out log-likelihood of each candidate, and paired differences to the best"
            keep(draw(choice), path, alt, "")


def draw(choice: Choice) -> Figure:
    """Two panels: log-likelihood of each candidate with the rule's reach, and its paired difference to the best."""
    figure = blank(1.35 + 0.3 * len(choice.rows) + 0.35 * len(choice.notes))
    left, right = figure.subplots(1, 2, sharey=True)
    for place, row in enumerate(choice.rows):
        _mean(left, place, row, choice)
        _difference(right, place, row, choice)
    right.axvline(0, color=FAINT, linewidth=0.8, zorder=1)
    if choice.best and choice.best.mean is not None and choice.best.error is not None:
        left.axvspan(choice.best.mean - choice.best.error, choice.best.mean, color=CHOSEN, alpha=0.12, linewidth=0)
    left.set_yticks(np.arange(len(choice.rows)), [_label(row) for row in choice.rows])
    left.set_ylim(len(choice.rows) - 0.4, -0.6)
    left.set(xlabel="held-out log-likelihood (nats per step)", title="Each candidate, ± one standard error")
    right.set(xlabel="nats per step above the best, same folds", title="Minus the best, ± one standard error")
    right.tick_params(axis="y", length=0)
    for axes in (left, right):
        axes.grid(axis="x", color="#e4e4e4")
        axes.set_axisbelow(True)
    _legend(figure, choice)
    return figure


def _mean(axes: Axes, place: int, row: Row, choice: Choice) -> None:
    if row.mean is None:
        return
    values = list(row.folds.values())
    axes.scatter(values, np.full(len(values), place), s=12, color=FAINT, alpha=0.5, linewidth=0, zorder=2)
    axes.errorbar(row.mean, place, xerr=row.error, fmt=_marker(row, choice), color=_colour(row, choice), capsize=4)


def _difference(axes: Axes, place: int, row: Row, choice: Choice) -> None:
    if row.difference is None:
        return
    mean, error = row.difference
    best = choice.best.folds if choice.best else {}
    each = [value - best[fold] for fold, value in row.folds.items() if fold in best]
    axes.scatter(each, np.full(len(each), place), s=12, color=FAINT, alpha=0.5, linewidth=0, zorder=2)
    axes.errorbar(mean, place, xerr=error, fmt=_marker(row, choice), color=_colour(row, choice), capsize=4)


def _marker(row: Row, choice: Choice) -> str:
    return "D" if row is choice.best else "s" if row is choice.chosen else "o"


def _colour(row: Row, choice: Choice) -> str:
    return CHOSEN if row is choice.chosen else INK if row.status == "scored" else FAINT


def _label(row: Row) -> str:
    return f"{row.candidate.name} ({row.candidate.parameters} parameters){STATUS[row.status]}"


def _legend(figure: Figure, choice: Choice) -> None:
    """What the marks mean, and the notes."""
    marks = ["diamond: best", "orange: chosen, the smallest in the band of one standard error below the best"]
    marks += ["grey dots: single folds"]
    lines = ["; ".join(marks), *(line for note in choice.notes for line in textwrap.wrap(f"Note: {note}.", 150))]
    figure.supxlabel("\n".join(lines), fontsize=8, color=INK, x=0.01, ha="left")
