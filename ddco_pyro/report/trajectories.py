"""Which options are active when, and trajectories in space coloured by it (SM 1.3, figure B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import label_names
from ddco_pyro.drawing.colours import add_legend, option_colour
from ddco_pyro.drawing.figures import FAINT, INK, blank, save
from ddco_pyro.drawing.page import Picture
from ddco_pyro.drawing.shown import LINES, MOST_STRETCHED, in_words, positions, spans, view
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import option_name
from ddco_pyro.segmenting.segments import Segmented, Segments, of_piece, of_run
from ddco_pyro.spec import PathSpec


@dataclass(frozen=True)
class LevelActivity:
    """One level over N demonstrations.

    :param names: the name of each choice, control first.
    :param paths: choices of the most likely path of each demonstration [T].
    """

    name: str
    names: Sequence[str]
    paths: Sequence[np.ndarray]

    @property
    def choices(self) -> list[int]:
        """The choices that can occur: without control where it is never chosen."""
        control = any((path == 0).any() for path in self.paths)
        return [choice for choice in range(len(self.names)) if choice or control]


@dataclass(frozen=True)
class Activity:
    """All levels, lowest first, over the same demonstrations.

    :param segmented: their segments, in the order and with the numbers of ``demonstrations_by_likelihood``.
    """

    levels: tuple[LevelActivity, ...]
    segmented: Segmented

    @property
    def choices(self) -> set[int]:
        """The choices that can occur at any level."""
        return {choice for level in self.levels for choice in level.choices}

    @property
    def names(self) -> list[str]:
        """The name of each choice, control first: those of all levels, the highest level first."""
        each: dict[int, list[str]] = {}
        for level in reversed(self.levels):
            for choice in range(len(level.names)):
                each.setdefault(choice, []).append(option_name(choice, level.names))
        return [" / ".join(dict.fromkeys(each[choice])) for choice in sorted(each)]


def activity(fit: Fit, demos: Demonstrations) -> Activity:
    """The activity of a fit with at least one level."""
    paths, segments = [list[np.ndarray]() for _ in fit.names], dict[str, Segments]()
    labels = {demo.name: {name: demo.labels[name] for name in fit.spec.demonstrations.label_names} for demo in demos}
    for piece in fit.infer(demos):
        for own, level in zip(paths, piece.path.choices, strict=True):
            own += [row[:steps].numpy() for row, steps in zip(level, piece.lengths, strict=True)]
        segments |= {demo.name: demo for demo in of_piece(fit, piece, labels, intervals=True)}
    levels = tuple(LevelActivity(*named, own) for named, own in zip(fit.names.items(), paths, strict=True))
    rows = {row.name: row for row in fit.metrics.demonstrations_by_likelihood}  # held out, where it trains too
    ordered = [
        replace(segments[name], log_likelihood=row.log_likelihood_per_step[fit.name], held_out=row.part == "valid")
        for name, row in rows.items()
        if name in segments
    ]
    segmented = of_run(fit, ordered, demos.frequency, label_names(demos.attributes))
    return Activity(levels, segmented)


# --- figure -----------------------------------------------------------------------------------------------------------

MOST_TRAJECTORIES = 40
MOST_POINTS = 300
TURN = 70.0
CHOSEN = (
    "It moves the most as the controls say; “ddco-pyro report RUN --set report.trajectory=KEY” draws another "
    "observation, [KEY, 3:6] other numbers of it, and a list of both a path for each arm. "
)


def picture(fit: Fit, demos: Demonstrations, activity: Activity, paths: Sequence[PathSpec]) -> Picture | None:
    """The demonstrations in space or in the plane; None without paths."""
    if not paths:
        return None
    places = [positions(demo, paths) for demo in demos]
    plane = places[0].shape[-1] == 2
    seen = "Both axes have one scale." if plane else "Seen along the direction in which the trajectories spread least."
    caption = (
        f"{min(len(demos), MOST_TRAJECTORIES)} demonstrations, coloured by the most likely option: "
        f"{in_words(paths, demos)}, in its own units. {'' if fit.spec.report.trajectory else CHOSEN}"
        f"Circles: first steps. {seen}"
    )
    names = [f"{paths[0].key}[{place}]" for place in paths[0].among(demos.observation_shapes[paths[0].key][0])]
    figure = draw(activity, places, names if len(paths) == 1 else ["x", "y", "z"][: len(names)])
    alt = f"Trajectories of {', '.join(map(str, paths))}, coloured by option"
    return save(figure, fit.run_folder / "figures" / "trajectories.png", alt, caption)


def draw(activity: Activity, places: Sequence[np.ndarray], names: Sequence[str]) -> Figure:
    """The positions of each demonstration [P, T_n, D], a panel for each level; one level in space from two sides.

    :param names: of the D axes.
    """
    plane = len(names) == 2
    figure = blank(0.55 + 4.2 * -(-max(2, len(activity.levels)) // 2))
    turns = (0.0, TURN) if len(activity.levels) == 1 and not plane else (0.0,)
    panels = [(level, turn) for level in reversed(activity.levels) for turn in turns]
    if plane:
        every = [*figure.subplots(-(-len(panels) // 2), min(2, len(panels)), squeeze=False).flat]
    else:
        figure.set_layout_engine("none")  # it leaves too little room for labels of 3D axes
        places_of_panels = _places(len(panels), figure.get_figheight())
        every = [figure.add_axes(place, projection="3d", proj_type="ortho") for place in places_of_panels]
    for axes, (level, turn) in zip(every, panels, strict=False):
        panel(axes, level, places, names, turn)
        axes.set_title(f"level “{level.name}”" + (f", turned by {turn:.0f}°" if turn else ""))
    add_legend(figure, activity.choices, activity.names, "outside lower center" if plane else "lower center")
    return figure


def panel(
    axes: Axes, level: LevelActivity, places: Sequence[np.ndarray], names: Sequence[str], turn: float = 0.0
) -> None:
    """One level over the positions [P, T_n, D], of at most :data:`MOST_TRAJECTORIES` demonstrations."""
    chosen = np.unique(np.linspace(0, len(places) - 1, min(len(places), MOST_TRAJECTORIES)).round().astype(int))
    lines, colours, dashes = [], [], []
    for row in chosen:
        length = places[row].shape[1]
        steps = np.arange(0, length, -(-length // MOST_POINTS))
        path = level.paths[row][steps]
        starts = np.flatnonzero(np.diff(path, prepend=-1))
        for start, end in zip(starts, [*starts[1:], len(steps) - 1], strict=True):
            for number, points in enumerate(places[row]):
                lines.append(points[steps[start : end + 1]])
                colours.append(to_rgba(option_colour(int(path[start]))))
                dashes.append(LINES[number % len(LINES)])
    kind = Line3DCollection if isinstance(axes, Axes3D) else LineCollection
    axes.add_collection(kind(lines, colors=colours, linewidths=1.3, linestyles=dashes))
    first = np.concatenate([places[row][:, 0] for row in chosen])
    more: dict[str, Any] = {"depthshade": False} if isinstance(axes, Axes3D) else {"zorder": 3}
    axes.scatter(*first.T, color="white", edgecolor=INK, linewidth=0.7, **{"s": 12, **more})
    _frame(axes, np.concatenate([places[row].reshape(-1, len(names)) for row in chosen]), names, turn)


def _places(count: int, height: float) -> list[tuple[float, float, float, float]]:
    """Panels, two in a row, as (left, bottom, width, height) in shares of the figure, titles and legend left out."""
    rows = -(-count // 2)
    bottom, each = 0.55 / height, (1 - 0.55 / height) / rows
    return [(0.5 * (n % 2), bottom + (rows - 1 - n // 2) * each, 0.5, 0.93 * each) for n in range(count)]


def _frame(axes: Axes, points: np.ndarray, names: Sequence[str], turn: float) -> None:
    """Limits, view and labels around positions [M, D]."""
    low, span = points.min(0), spans(points)
    if not isinstance(axes, Axes3D):
        axes.set(xlabel=names[0], ylabel=names[1], aspect="equal")
        axes.margins(0.05)
        return
    axes.set(xlim=(low[0], low[0] + span[0]), ylim=(low[1], low[1] + span[1]), zlim=(low[2], low[2] + span[2]))
    if span.max() <= MOST_STRETCHED * span.min():
        axes.set_box_aspect(span / span.max(), zoom=0.88)
    elevation, azimuth = view(points, span if span.max() > MOST_STRETCHED * span.min() else np.ones(3))
    axes.view_init(elev=elevation, azim=azimuth + turn)
    for name, axis in zip(names, (axes.xaxis, axes.yaxis, axes.zaxis), strict=True):
        axis.set_pane_color((1, 1, 1, 1))
        axis.set_label_text(name)
        axis.line.set_color(FAINT)
    axes.locator_params(nbins=5)
    axes.tick_params(labelsize=7)
