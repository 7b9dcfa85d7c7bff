"""Trajectories in space, coloured by option (paper, SM 1.3, figure B)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import add_legend, option_colour
from ddco_pyro.drawing.figures import FAINT, INK, blank, save
from ddco_pyro.drawing.page import Picture
from ddco_pyro.drawing.shown import MOST_STRETCHED, position_key, spans, view
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.report.activity import Activity, LevelActivity

MOST_TRAJECTORIES = 40
MOST_POINTS = 300
TURN = 70.0
CHOSEN = (
    "Among observations of three numbers or more, it moves the most as the controls say; report.trajectory in the spec "
    "names another. "
)


def picture(fit: Fit, demos: Demonstrations, activity: Activity) -> Picture | None:
    """The demonstrations in space; None where no observation looks like a position."""
    named = fit.spec.report.trajectory
    key = named or position_key(demos)
    if key is None:
        return None
    caption = (
        f"{min(len(demos), MOST_TRAJECTORIES)} demonstrations in space, coloured by the most likely option: first "
        f"three numbers of observation “{key}”, in its own units. {'' if named else CHOSEN}Circles: first steps. Seen "
        "from the direction in which the trajectories spread the most."
    )
    figure = draw(activity, [np.asarray(demo.observations[key])[:, :3] for demo in demos], key)
    alt = f"Trajectories of {key} in three dimensions, coloured by option"
    return save(figure, fit.run_folder / "figures" / "trajectories.png", alt, caption)


def draw(activity: Activity, positions: Sequence[np.ndarray], key: str) -> Figure:
    """The positions [T_n, 3] of each demonstration, a panel for each level; a single level is seen from two sides."""
    figure = blank(0.55 + 4.2 * -(-max(2, len(activity.levels)) // 2))
    figure.set_layout_engine("none")  # it leaves too little room for labels of 3D axes
    turns = (0.0, TURN) if len(activity.levels) == 1 else (0.0,)
    panels = [(level, turn) for level in reversed(activity.levels) for turn in turns]
    for place, (level, turn) in zip(_places(len(panels), figure.get_figheight()), panels, strict=True):
        axes = figure.add_axes(place, projection="3d", proj_type="ortho")
        panel(axes, level, positions, key, turn)
        axes.set_title(f"level “{level.name}”" + (f", turned by {turn:.0f}°" if turn else ""))
    add_legend(figure, activity.choices, activity.names, "lower center")
    return figure


def panel(axes: Axes3D, level: LevelActivity, positions: Sequence[np.ndarray], key: str, turn: float = 0.0) -> None:
    """One level over the positions [T_n, 3], of at most :data:`MOST_TRAJECTORIES` demonstrations."""
    chosen = np.unique(np.linspace(0, len(positions) - 1, min(len(positions), MOST_TRAJECTORIES)).round().astype(int))
    lines, colours = [], []
    for row in chosen:
        steps = np.arange(0, len(positions[row]), -(-len(positions[row]) // MOST_POINTS))
        points = positions[row][steps]
        lines.append(np.stack([points[:-1], points[1:]], axis=1))
        colours += [to_rgba(option_colour(int(choice))) for choice in level.path[row][steps[:-1]]]
    if colours:
        axes.add_collection3d(Line3DCollection(np.concatenate(lines), colors=colours, linewidths=1.3))
    first = np.stack([positions[row][0] for row in chosen])
    axes.scatter(*first.T, color="white", edgecolor=INK, s=12, linewidth=0.7, depthshade=False)
    _frame(axes, np.concatenate([positions[row] for row in chosen]), key, turn)


def _places(count: int, height: float) -> list[tuple[float, float, float, float]]:
    """Panels, two in a row, as (left, bottom, width, height) in shares of the figure, titles and legend left out."""
    rows = -(-count // 2)
    bottom, each = 0.55 / height, (1 - 0.55 / height) / rows
    return [(0.5 * (n % 2), bottom + (rows - 1 - n // 2) * each, 0.5, 0.93 * each) for n in range(count)]


def _frame(axes: Axes3D, points: np.ndarray, key: str, turn: float) -> None:
    low, span = points.min(0), spans(points)
    axes.set(xlim=(low[0], low[0] + span[0]), ylim=(low[1], low[1] + span[1]), zlim=(low[2], low[2] + span[2]))
    if span.max() <= MOST_STRETCHED * span.min():
        axes.set_box_aspect(span / span.max(), zoom=0.88)
    elevation, azimuth = view(points, span if span.max() > MOST_STRETCHED * span.min() else np.ones(3))
    axes.view_init(elev=elevation, azim=azimuth + turn)
    for number, axis in enumerate((axes.xaxis, axes.yaxis, axes.zaxis)):
        axis.set_pane_color((1, 1, 1, 1))
        axis.set_label_text(f"{key}[{number}]")
        axis.line.set_color(FAINT)
    axes.locator_params(nbins=5)
    axes.tick_params(labelsize=7)
