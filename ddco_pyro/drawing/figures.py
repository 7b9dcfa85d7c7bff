"""Figures in SVG: values with intervals, transitions, trajectories and curves; also as files of their own."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.page import Drawing
from ddco_pyro.drawing.shown import LINES, jpeg
from ddco_pyro.metrics import Difference
from ddco_pyro.names import option_colour

WIDTH = 900
"""Units across a drawing as wide as the page."""

INK = "var(--ink)"
FAINT = "var(--soft)"
ACCENT = "#e76300"

LOOKS = (
    "<style>svg { --ink: #222; --soft: #5c5c5c; --paper: #fff; --line: #ccc; background: #fff; font: 11px "
    "sans-serif; fill: var(--ink); } .soft { fill: var(--soft); } .faint { fill: none; stroke: var(--line); }"
    "</style>"
)
"""Of a drawing that stands alone; a page has these of its own."""

ROW, TITLE, AXIS = 26.0, 24.0, 42.0
"""Heights of a row of a plot, of what is above and of what is below."""


def svg(width: float, height: float, label: str, parts: Sequence[str]) -> Markup:
    """An SVG element of this size in its own units.

    :param parts: its contents, escaped already.
    """
    return Markup('<svg viewBox="0 0 {:.0f} {:.0f}" role="img" aria-label="{}">{}</svg>').format(
        width, height, label, Markup("\n").join(map(Markup, parts))
    )


def words_at(x: float, y: float, text: str, anchor: str = "middle", kind: str = "") -> Markup:
    """A text beside a place: ``start``, ``middle`` or ``end`` of the text is there."""
    shape = Markup('<text x="{:.1f}" y="{:.1f}" text-anchor="{}" class="{}">{}</text>')
    return shape.format(x, y, anchor, kind, text)


def save(drawing: Markup, path: Path, caption: str = "") -> Drawing:
    """Write a drawing as a file of its own; the same drawing for a page."""
    head, rest = str(drawing).removeprefix("<svg").split(">", 1)
    write_text(path, f'<svg xmlns="http://www.w3.org/2000/svg"{head}>{LOOKS}{rest}\n')
    return Drawing(drawing, caption)


def picture(pixels: np.ndarray, alt: str, caption: str = "") -> Drawing:
    """A picture uint8 [H, W, 3] for a page, as JPEG.

    :param alt: what is said where it cannot be seen.
    """
    image = Markup('<img src="{}" alt="{}">')
    return Drawing(image.format(data_uri(jpeg(pixels), "image/jpeg"), alt), caption)


def film(content: bytes, caption: str) -> Drawing:
    """A film in mp4 for a page."""
    video = Markup('<video controls muted loop playsinline preload="metadata" src="{}"></video>')
    return Drawing(video.format(data_uri(content, "video/mp4")), caption)


def data_uri(content: bytes, kind: str) -> str:
    """Bytes as ``data:<kind>;base64,...``."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its interval (NaN where unknown), the single values behind it, and its colour.

    :param hollow: a second value, drawn as a hollow circle.
    """

    value: float
    low: float = np.nan
    high: float = np.nan
    points: Sequence[float] = ()
    hollow: float | None = None
    colour: str = INK

    @classmethod
    def around(
        cls, value: float, error: float | None, points: Sequence[float] = (), colour: str = INK
    ) -> Interval:
        """The value ± an error, which may be unknown."""
        half = np.nan if error is None else error
        return cls(value, value - half, value + half, points, colour=colour)

    @classmethod
    def of(cls, difference: Difference, points: Sequence[float] = (), colour: str = INK) -> Interval:
        """A difference ± its standard error."""
        return cls.around(difference.nats_per_step, difference.standard_error, points, colour)

    @property
    def numbers(self) -> list[float]:
        """All numbers that are drawn."""
        hollow = [] if self.hollow is None else [self.hollow]
        every = [self.value, self.low, self.high, *self.points, *hollow]
        return [number for number in every if np.isfinite(number)]


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


def interval_plot(
    names: Sequence[str], panels: Sequence[Panel], alt: str, notes: Sequence[str] = ()
) -> Markup:
    """A forest plot: a row for each name, panels side by side, and ``notes`` below, a line each."""
    left = min(12 + 6.2 * max(map(len, names)), WIDTH / 2)  # of longer names the ends are seen
    height = TITLE + ROW * len(names) + AXIS
    parts: list[str] = []
    for place, name in enumerate(names):
        parts.append(words_at(left - 8, TITLE + ROW * (place + 0.65), name, "end"))
    for number, panel in enumerate(panels):
        each = (WIDTH - left) / len(panels)
        parts += _panel(panel, left + number * each, each - 14, TITLE + ROW * len(names))
    for place, text in enumerate(notes, start=1):
        parts.append(words_at(4, height + 15 * place, text, "start", "soft"))
    return svg(WIDTH, height + 15 * len(notes) + 4, alt, parts)


def _panel(panel: Panel, left: float, width: float, bottom: float) -> list[str]:
    """The parts of a panel, whose axis is at ``bottom``."""
    every = [number for row in panel.rows if row for number in row.numbers]
    every += [*(panel.band or ()), *([] if panel.line is None else [panel.line])]
    low, high = min(every), max(every)
    span = (high - low) or 1.0

    def at(value: float) -> float:
        return left + 8 + (width - 16) * (value - low) / span

    def vertical(x: float, top: float, end: float, looks: str) -> str:
        return f'<line x1="{x:.1f}" y1="{top:.1f}" x2="{x:.1f}" y2="{end:.1f}" {looks}/>'

    parts: list[str] = [words_at(left + 8, TITLE - 10, panel.title, "start")]
    if panel.band is not None:
        first, last = (at(end) for end in panel.band)
        size = f'width="{last - first:.1f}" height="{bottom - TITLE:.1f}"'
        parts.append(f'<rect x="{first:.1f}" y="{TITLE:.1f}" {size} fill="{ACCENT}" opacity="0.15"/>')
    power = 10.0 ** np.floor(np.log10(span / 5))
    step = next(power * count for count in (1, 2, 5, 10) if 5 * power * count >= span)
    for number in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step:
        parts.append(vertical(at(number), TITLE, bottom, 'class="faint"'))
        parts.append(words_at(at(number), bottom + 14, f"{number + 0.0:.10g}".replace("-", "−"), kind="soft"))
    if panel.line is not None:
        parts.append(vertical(at(panel.line), TITLE, bottom, f'stroke="{FAINT}"'))
    parts.append(words_at(left + width / 2, bottom + 30, panel.axis, kind="soft"))
    for place, row in enumerate(panel.rows):
        y = TITLE + ROW * (place + 0.5)
        for point in row.points if row else ():
            parts.append(f'<circle cx="{at(point):.1f}" cy="{y:.1f}" r="2.2" fill="{FAINT}" opacity="0.5"/>')
        if row and row.hollow is not None:
            looks = f'r="4" fill="var(--paper)" stroke="{row.colour}"'
            parts.append(f'<circle cx="{at(row.hollow):.1f}" cy="{y:.1f}" {looks}/>')
        if row and np.isfinite(row.low):
            looks = f'stroke="{row.colour}" stroke-width="1.4"'
            parts += [vertical(at(end), y - 4, y + 4, looks) for end in (row.low, row.high)]
            ends = f'x1="{at(row.low):.1f}" y1="{y:.1f}" x2="{at(row.high):.1f}" y2="{y:.1f}"'
            parts.append(f"<line {ends} {looks}/>")
        if row and np.isfinite(row.value):
            parts.append(f'<circle cx="{at(row.value):.1f}" cy="{y:.1f}" r="4" fill="{row.colour}"/>')
    return parts


# --- transitions between options ----------------------------------------------------------------------------

RAREST = 0.01
"""Transitions that make up a smaller share of all are not drawn; starts and ends, of all demonstrations."""

LETTERS = 16
"""Of a name beside a node, at most."""


def transition_graph(
    counts: np.ndarray, shares: Sequence[float], names: Sequence[str], order: Sequence[int]
) -> Markup:
    """Options in a row between start and end; arcs above the row lead to the right, arcs below to the left.

    :param counts: of transitions between segments [1 + k + 1, 1 + k + 1]; the last row is the start of
        demonstrations and the last column their end.
    :param shares: of steps, of each choice; the areas of nodes.
    :param order: the choices that are drawn, from left to right.
    """
    outside = len(counts) - 1
    gap = WIDTH / (2 + len(order))
    at = {choice: (place + 0.5) * gap for place, choice in enumerate(order, start=1)}
    starts, ends = at | {outside: 0.5 * gap}, at | {outside: WIDTH - 0.5 * gap}
    named = [*names, "start"]
    rarest = {True: max(1, RAREST * counts[outside].sum()), False: max(1, RAREST * counts.sum())}
    pairs = [(a, b) for a in starts for b in ends if counts[a, b] >= rarest[outside in (a, b)]]
    edges = [(a, b, int(counts[a, b])) for a, b in pairs]
    up = max((_rise(ends[b] - starts[a], gap) for a, b in pairs if ends[b] > starts[a]), default=0.0) + 34
    down = max((_rise(starts[a] - ends[b], gap) for a, b in pairs if ends[b] < starts[a]), default=0.0) + 58
    parts: list[str] = []
    for first, second, count in sorted(edges, key=lambda edge: edge[2]):
        target = "end" if second == outside else named[second]
        title = f"{named[first]} → {target}: {count} of {int(counts[first].sum())}"
        share = count / counts[first].sum()
        parts.append(_edge(starts[first], ends[second], up, gap, share, title, str(count)))
    for choice, x in at.items():
        radius = 7 + 26 * np.sqrt(shares[choice])
        name = names[choice]
        title = f"{name}: {shares[choice]:.1%} of all steps"
        circle = '<circle cx="{:.1f}" cy="{:.1f}" r="{:.1f}" fill="{}" stroke="var(--line)"/>'
        node = Markup("<g><title>{}</title>" + circle + "</g>")
        parts.append(node.format(title, x, up, radius, option_colour(choice)))
        short = name if len(name) <= LETTERS else name[: LETTERS - 1] + "…"
        parts.append(words_at(x, up + radius + 14, short))
    for x, word in ((starts[outside], "start"), (ends[outside], "end")):
        node = Markup('<circle cx="{:.1f}" cy="{:.1f}" r="5" fill="var(--paper)" stroke="var(--ink)"/>')
        parts.append(node.format(x, up))
        parts.append(words_at(x, up + 20, word, kind="soft"))
    return svg(WIDTH, up + down, "Transitions between options", parts)


def _rise(distance: float, gap: float) -> float:
    """The height of an arc over so great a distance."""
    return 0 if abs(distance) < 1.5 * gap and distance > 0 else 22 + 0.16 * abs(distance)


def _edge(start: float, end: float, y: float, gap: float, share: float, title: str, count: str) -> Markup:
    """An arc with its arrow head and its count; ``share`` of the transitions from its start."""
    width, side = 0.8 + 5 * share, 1 if end > start else -1
    if start == end:
        path = f"M{start - 9:.1f},{y - 8:.1f} c-25,-54 43,-54 18,0"
        middle, top = start, y - 48.5
    else:
        rise = side * _rise(end - start, gap)
        middle, top = (start + end) / 2, y - rise * 1.0
        path = f"M{start:.1f},{y:.1f} Q{middle:.1f},{y - 2 * rise:.1f} {end:.1f},{y:.1f}"
    head = f"M{middle - side * 5:.1f},{top - 4:.1f} l{side * 8:.1f},4 l{-side * 8:.1f},4 z"
    return Markup(
        '<g opacity="{:.2f}"><title>{}</title><path class="edge" d="{}" stroke-width="{:.1f}"/>'
        '<path d="{}" fill="var(--soft)"/>{}</g>'
    ).format(0.45 + 0.55 * share, title, path, width, head, words_at(middle, top - 7, count))


# --- instances of an option ---------------------------------------------------------------------------------

CELL = 110.0
"""Units across a cell of the grid of instances."""

MARGIN = 8.0

DASHES = {"solid": "none", "dashed": "5 2.5", "dotted": "1.2 2"}


def fitted(paths: Sequence[np.ndarray], width: float, height: float) -> list[np.ndarray]:
    """Paths in the plane [P, T, 2], moved and scaled together into a box."""
    every = np.concatenate([path.reshape(-1, 2) for path in paths])
    low, span = every.min(0), np.ptp(every, axis=0)
    room = np.array([width, height]) - 2 * MARGIN
    scale = min(room / np.where(span > 0, span, 1e-9))
    return [(path - low - span / 2) * scale + np.array([width, height]) / 2 for path in paths]


def line(points: np.ndarray, **looks: Any) -> Markup:
    """A line through points [T, 2], at most 60 of them."""
    chosen = points[np.unique(np.linspace(0, len(points) - 1, min(len(points), 60)).round().astype(int))]
    drawn = " ".join(f"{x:.1f},{y:.1f}" for x, y in chosen)
    attributes = Markup("").join(
        Markup(' {}="{}"').format(name.rstrip("_").replace("_", "-"), value) for name, value in looks.items()
    )
    return Markup('<polyline points="{}" fill="none"{}/>').format(drawn, attributes)


def typical_paths(
    paths: Sequence[np.ndarray], segments: Sequence[tuple[int, int, int]], colour: str
) -> Markup:
    """Segments in colour over whole demonstrations; circle, square and triangle: first, middle and last step.

    :param paths: of demonstrations in the plane [P, T, 2].
    :param segments: (demonstration, first step, step after the last).
    """
    width, height = 2.4 * CELL, 2 * CELL
    placed = fitted(paths, width, height)
    parts: list[str] = [line(path, class_="faint") for each in placed for path in each]
    mark = f'fill="{colour}" stroke="var(--paper)" stroke-width="1"'
    for row, start, end in segments:
        for place, path in enumerate(placed[row]):
            dashes = DASHES[LINES[place % len(LINES)]]
            parts.append(line(path[start:end], stroke_dasharray=dashes, stroke=colour, stroke_width=2))
            (x, y), (x1, y1), (x2, y2) = (path[step] for step in (start, (start + end - 1) // 2, end - 1))
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5" {mark}/>')
            parts.append(f'<rect x="{x1 - 3.5:.1f}" y="{y1 - 3.5:.1f}" width="7" height="7" {mark}/>')
            parts.append(f'<path d="M{x2:.1f},{y2 - 5:.1f} l5,9 l-10,0 z" {mark}/>')
    return svg(width, height, "Trajectories of typical segments", parts)


MOST_PATHS = 40
"""Demonstrations in a drawing of all."""


def paths_of_options(paths: Sequence[np.ndarray], options: Sequence[np.ndarray]) -> Markup:
    """Whole demonstrations, each step in the colour of its option; a circle is a first step.

    :param paths: of demonstrations in the plane [P, T, 2]; at most :data:`MOST_PATHS` of them are drawn,
        evenly spread.
    :param options: the most likely options of each [T].
    """
    rows = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), MOST_PATHS)).round().astype(int))
    parts: list[str] = []
    for row, placed in zip(rows, fitted([paths[row] for row in rows], WIDTH, WIDTH / 2), strict=True):
        starts = np.flatnonzero(np.diff(options[row], prepend=-1))
        for place, path in enumerate(placed):
            looks = {"stroke_width": 1.5, "stroke_dasharray": DASHES[LINES[place % len(LINES)]]}
            for start, end in zip(starts, [*starts[1:], len(path) - 1], strict=True):
                colour = option_colour(int(options[row][start]))
                parts.append(line(path[start : end + 1], stroke=colour, **looks))
            first = '<circle cx="{:.1f}" cy="{:.1f}" r="3" fill="white" stroke="#222222"/>'
            parts.append(first.format(*path[0]))
    return svg(WIDTH, WIDTH / 2, "Trajectories coloured by option", parts)


def curves(
    values: Mapping[str, Sequence[np.ndarray]],
    looks: Sequence[Mapping[str, Any]],
    columns: int = 2,
    width: float = 1.5 * CELL,
) -> Markup:
    """A panel for each name: lines over time, between the largest and the smallest number.

    :param values: of each line [T_n].
    :param looks: attributes of the lines, in turn.
    """
    columns, height = min(columns, len(values)), 0.9 * CELL
    parts: list[str] = []
    for place, (name, each) in enumerate(values.items()):
        low, high = min(array.min() for array in each), max(array.max() for array in each)
        longest = max(max(map(len, each)) - 1, 1)
        right, below = width * (place % columns), height * (place // columns)
        parts.append(f'<g transform="translate({right:.0f},{below:.0f})">')
        parts.append(f'<rect x="2" y="16" width="{width - 8:.0f}" height="{height - 22:.0f}" class="faint"/>')
        parts += [words_at(2, 11, name, "start"), words_at(width - 9, 26, f"{high:.3g}", "end", "soft")]
        parts.append(words_at(width - 9, height - 9, f"{low:.3g}", "end", "soft"))
        for array, look in zip(each, cycle(looks), strict=False):
            across = 6 + (width - 50) * np.arange(len(array)) / longest
            down = height - 11 - (height - 33) * (array - low) / ((high - low) or 1)
            parts.append(line(np.stack([across, down], axis=1), stroke_width=1.2, opacity=0.75, **look))
        parts.append("</g>")
    rows = -(-len(values) // columns)
    return svg(columns * width, rows * height, "Numbers over time", parts)
