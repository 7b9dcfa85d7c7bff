"""Learning curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ddco_pyro.drawing import words
from ddco_pyro.drawing.pictures import INK, blank
from ddco_pyro.evaluation.schema import read_table, refit

COLUMNS = 4
TUNE = "#c2410c"


@dataclass(frozen=True)
class Stage:
    """One stage of one model: for each restart an array of (epoch, train, tune) [E, 3], nats per step."""

    model: str
    name: str
    restarts: Sequence[np.ndarray]

    @property
    def title(self) -> str:
        """Model and stage in words."""
        return f"{words.method(self.model)}: {words.stage(self.name)}"


def stages(histories: Mapping[str, Path]) -> list[Stage]:
    """The stages in ``history.csv`` of each model, in the order in which they were trained."""
    trained = []
    for model, path in histories.items():
        rows = read_table(path, _epoch, refit(path.parent, "it and metrics.json"))
        for stage in dict.fromkeys(stage for stage, _, _ in rows):
            own = [(restart, values) for name, restart, values in rows if name == stage]
            numbers = dict.fromkeys(restart for restart, _ in own)
            curves = [np.array([values for restart, values in own if restart == number]) for number in numbers]
            trained.append(Stage(model, stage, curves))
    return trained


def _epoch(row: Mapping[str, str]) -> tuple[str, int, list[float]]:
    """The stage, restart and numbers of an epoch."""
    return row["stage"], int(row["restart"]), [float(row[key]) for key in ("epoch", "train", "tune")]


def draw(stages: Sequence[Stage]) -> Figure:
    """A panel for each stage, a pair of lines for each restart."""
    columns = min(COLUMNS, len(stages))
    rows = -(-len(stages) // columns)
    figure = blank(0.4 + 2.1 * rows)
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes, stage in zip(panels.flat, stages, strict=False):
        _panel(axes, stage)
    for axes in panels.flat[len(stages) :]:
        axes.set_visible(False)
    for axes in panels[:, 0]:
        axes.set_ylabel("nats per step")
    lines = [Line2D([], [], color=INK), Line2D([], [], color=TUNE, linestyle=(0, (4, 1.5)))]
    figure.legend(lines, ["training demonstrations", "tuning demonstrations"], loc="outside lower center", ncols=2)
    return figure


def _panel(axes: Axes, stage: Stage) -> None:
    faint = 1.0 if len(stage.restarts) == 1 else 0.6
    for curve in stage.restarts:
        axes.plot(curve[:, 0], curve[:, 1], color=INK, linewidth=1.1, alpha=faint)
        axes.plot(curve[:, 0], curve[:, 2], color=TUNE, linewidth=1.1, alpha=faint, linestyle=(0, (4, 1.5)))
    axes.set(
        title=stage.title, xlabel="epoch", ylim=_limits(np.concatenate([curve[:, 1:] for curve in stage.restarts]))
    )
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Cut off the steep rise of the first epochs where it would flatten all the rest."""
    low, bottom, top = float(values.min()), float(np.percentile(values, 10)), float(values.max())
    if top - low > 3 * (top - bottom) > 0:
        low = top - 3 * (top - bottom)
    margin = 0.05 * (top - low) or 1.0
    return low - margin, top + margin
