"""Segments as one self-contained HTML page: the timeline of every demonstration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np

from ddco_pyro.colours import option_colour
from ddco_pyro.files import write_text
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments

SHADES = ("#f2f2f2", "#d4d4d4")
"""Labels that were there before have no colours: those belong to options. Their segments alternate in shade."""

ROOM = 0.03
"""A segment is written upon if it takes more than this part of the longest demonstration."""


MOST_BOXES = 100_000
"""Segments that a page shows, about: more are slow in any browser, and take much memory to write."""


@dataclass(frozen=True)
class Box:
    """One segment on the page: where it lies, in percent of the longest demonstration, and what it says."""

    left: str
    width: str
    colour: str
    ink: str
    text: str
    title: str


def write_page(path: Path, found: Segmented, run: str, file: str) -> None:
    """Write the page, whole or not at all; whatever comes from files is escaped."""
    shown = list(_first(found))
    longest = max(len(one) for one in shown)
    page = {
        "run": run,
        "file": file,
        "levels": [_level(name, count, found) for name, count in found.counts.items()],
        "demonstrations": [
            {"name": one.name, "steps": _steps(len(one), found), "rows": list(_rows(one, found, longest))}
            for one in shown
        ],
        "all": len(found),
        "longest": _steps(longest, found),
    }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ddco_pyro.segmenting", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    write_text(path, environment.get_template("page.html.j2").render(page))


def _first(found: Segmented) -> Iterator[Segments]:
    """As many demonstrations as the page shows: about :data:`MOST_BOXES` segments, one demonstration at least."""
    boxes = 0
    for one in found.segments:
        if boxes >= MOST_BOXES:
            return
        boxes += sum(int(level.boundaries.sum()) for level in one.levels.values())
        yield one


def _steps(steps: int, found: Segmented) -> str:
    return f"{steps} steps" + (f", {steps / found.frequency:.3g} s" if found.frequency else "")


def _rows(one: Segments, found: Segmented, longest: int) -> Iterator[dict[str, Any]]:
    for name, level in reversed(one.levels.items()):
        yield {"name": name, "boxes": [_option_box(level, run, found, longest) for run in level.runs()]}
    for name, values in one.labels.items():
        if name not in one.levels and not name.endswith("_boundary"):
            yield {"name": name, "boxes": list(_label_boxes(name, values, longest))}


def _option_box(level: LevelLabels, run: tuple[int, int, int], found: Segmented, longest: int) -> Box:
    option, start, end = run
    colour = option_colour(option)
    mean = float(level.probability[start:end].mean())
    when = f" ({start / found.frequency:.3g} to {end / found.frequency:.3g} s)" if found.frequency else ""
    title = f"{_name(option)}, steps {start} to {end - 1}{when}, probability {mean:.2f}"
    return _box(start, end, longest, colour, str(option) if option else "", title)


def _label_boxes(name: str, values: np.ndarray, longest: int) -> Iterator[Box]:
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    for number, (start, end) in enumerate(pairwise(edges)):
        value = str(values[start])
        yield _box(start, end, longest, SHADES[number % 2], value, f"{name} {value}, steps {start} to {end - 1}")


def _box(start: int, end: int, longest: int, colour: str, text: str, title: str) -> Box:
    shown = text if end - start > ROOM * longest else ""
    left, width = f"{100 * start / longest:.3f}", f"{100 * (end - start) / longest:.3f}"
    return Box(left, width, colour, _ink(colour), shown, title)


def _ink(colour: str) -> str:
    """Black or white, whichever can be read on this colour."""
    red, green, blue = matplotlib.colors.to_rgb(colour)
    return "#000" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "#fff"


def _name(option: int) -> str:
    return f"option {option}" if option else "control"


def _level(name: str, count: int, found: Segmented) -> dict[str, Any]:
    """How much of the time each option of a level takes, how often, and for how long."""
    runs = [run for one in found.segments for run in one.levels[name].runs()]
    total = sum(end - start for _, start, end in runs)
    options = []
    for option in range(count + 1):
        lengths = [end - start for choice, start, end in runs if choice == option]
        if option or lengths:
            typical = float(np.median(lengths)) if lengths else None
            options.append(
                {
                    "name": _name(option),
                    "colour": option_colour(option),
                    "share": f"{sum(lengths) / total:.1%}",
                    "segments": len(lengths),
                    "length": "-" if typical is None else _typical(typical, found),
                    "in": sum(any(c == option for c, _, _ in one.levels[name].runs()) for one in found.segments),
                }
            )
    return {"name": name, "options": options}


def _typical(steps: float, found: Segmented) -> str:
    return f"{steps:g} steps" + (f" ({steps / found.frequency:.3g} s)" if found.frequency else "")
