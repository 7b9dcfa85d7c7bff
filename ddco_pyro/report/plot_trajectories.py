"""Trajectories in space, coloured by option (the paper's figure B of SM 1.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.pictures import FAINT, INK, blank
from ddco_pyro.report.activity import Activity, LevelActivity
from ddco_pyro.report.strips import legend

MOST_TRAJECTORIES = 40
MOST_POINTS = 300
TURN = 70.0
LEAST_OBLIQUE = 15.0
"""Degrees; looking straight along an axis would hide its scale."""

MOST_STRETCHED = 4.0
"""Axes whose ranges differ by more than this are not drawn to one scale."""


def position_key(demos: Demonstrations) -> str | None:
    """The vector of at least three numbers that moves the most (:func:`movement`); None where none of them does."""
    keys = [key for key, shape in demos.observation_shapes.items() if len(shape) == 1 and shape[0] >= 3]
    moves = {key: movement([np.asarray(demo.observations[key]) for demo in demos]) for key in keys}
    best = max(moves, key=moves.__getitem__, default=None)
    return best if best is not None and moves[best] > 0 else None


def positions(demos: Demonstrations, key: str) -> list[np.ndarray]:
    """The first three numbers of an observation of each demonstration, [T, 3]."""
    return [np.asarray(demo.observations[key])[:, :3] for demo in demos]


def movement(values: Sequence[np.ndarray]) -> float:
    """How much like a position the first three of n numbers [T, n] move, from 0 to 1; the product of three parts.

    - Their standard deviation within demonstrations over that of all of them: 0 for a goal that is set anew for each
      demonstration.
    - How far a demonstration gets, measured across the box around it, for T steps as long as its (root mean square)
      step: 1 along a straight line at one speed, little for a velocity, for noise, and for what hardly ever moves.
    - The part of the numbers that is drawn, 3 / n.
    """
    points = [array[:, :3].astype(float) for array in values]
    reach = float(np.mean([_reach(path) for path in points]))
    if reach == 0:
        return 0.0
    within = np.mean([path.var(0).sum() for path in points])
    between = np.array([path.mean(0) for path in points]).var(0).sum()
    return float(np.sqrt(within / (within + between))) * reach * 3 / values[0].shape[1]


def _reach(points: np.ndarray) -> float:
    """The diagonal of the box around positions [T, 3], over T - 1 times the root mean square of their steps."""
    steps = np.diff(points, axis=0)
    length = np.sqrt(np.square(steps).sum() * len(steps))
    return float(np.linalg.norm(np.ptp(points, axis=0)) / length) if length > 0 else 0.0


def draw(activity: Activity, positions: Sequence[np.ndarray], key: str) -> Figure:
    """The positions [T_n, 3] of each demonstration, once for each level; a single level is seen from two sides."""
    figure = blank(0.55 + 4.2 * -(-max(2, len(activity.levels)) // 2))
    figure.set_layout_engine("none")  # it does not know how much room labels in space take
    turns = (0.0, TURN) if len(activity.levels) == 1 else (0.0,)
    panels = [(level, turn) for level in reversed(activity.levels) for turn in turns]
    for place, (level, turn) in zip(_places(len(panels), figure.get_figheight()), panels, strict=True):
        axes = figure.add_axes(place, projection="3d", proj_type="ortho")
        panel(axes, level, positions, key, turn)
        axes.set_title(f"level “{level.name}”" + (f", turned by {turn:.0f}°" if turn else ""))
    choices = sorted({choice for level in activity.levels for choice in level.choices})
    figure.legend(handles=legend(choices), loc="lower center", ncols=min(len(choices), 11), handlelength=1)
    return figure


def panel(axes: Axes3D, level: LevelActivity, positions: Sequence[np.ndarray], key: str, turn: float = 0.0) -> None:
    """One level over the positions [T_n, 3], of at most :data:`MOST_TRAJECTORIES` demonstrations."""
    chosen = np.unique(np.linspace(0, len(positions) - 1, min(len(positions), MOST_TRAJECTORIES)).round().astype(int))
    for row in chosen:
        _trajectory(axes, positions[row], level.path[row])
    _frame(axes, np.concatenate([positions[row] for row in chosen]), key, turn)


def _places(count: int, height: float) -> list[tuple[float, float, float, float]]:
    """Panels two in a row, (left, bottom, width, height) in parts of the figure; room for titles and the legend."""
    rows = -(-count // 2)
    bottom, each = 0.55 / height, (1 - 0.55 / height) / rows
    return [(0.5 * (n % 2), bottom + (rows - 1 - n // 2) * each, 0.5, 0.93 * each) for n in range(count)]


def _trajectory(axes: Axes3D, positions: np.ndarray, path: np.ndarray) -> None:
    steps = np.arange(0, len(positions), -(-len(positions) // MOST_POINTS))
    points = positions[steps]
    colours = [to_rgba(option_colour(int(choice))) for choice in path[steps]]
    if len(points) > 1:
        axes.add_collection3d(
            Line3DCollection(np.stack([points[:-1], points[1:]], axis=1), colors=colours, linewidths=1.3)
        )
    axes.scatter(*points[0], color="white", edgecolor=INK, s=12, linewidth=0.7, depthshade=False)


def _frame(axes: Axes3D, points: np.ndarray, key: str, turn: float) -> None:
    low, high = points.min(0), points.max(0)
    span = np.where(high > low, high - low, 1.0)
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


def view(points: np.ndarray, span: np.ndarray) -> tuple[float, float]:
    """Elevation and azimuth (degrees) from which positions [M, 3] spread the most: along their least spread direction.

    The third axis stays upright, so the elevation lies between 15 and 45 degrees, and no axis is looked along.
    """
    normal = np.linalg.eigh(np.cov((points / span).T))[1][:, 0] if len(points) > 1 else np.array([1.0, 1.0, 1.0])
    normal = -normal if normal[2] < 0 else normal
    elevation = float(np.clip(np.degrees(np.arcsin(normal[2])), 15, 45))
    quarter, rest = divmod(float(np.degrees(np.arctan2(normal[1], normal[0]))), 90)
    return elevation, 90 * quarter + float(np.clip(rest, LEAST_OBLIQUE, 90 - LEAST_OBLIQUE))
