"""Options in the report: how each is used, where it is active in space, and its segments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from markupsafe import Markup

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.page import Block, Cell, Section, Table, Text, note
from ddco_pyro.drawing.timeline import Timelines
from ddco_pyro.drawing.words import duration, number, percent
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import NamedByLabel
from ddco_pyro.names import numbered_name
from ddco_pyro.report import trajectories
from ddco_pyro.report.trajectories import Activity
from ddco_pyro.segmenting.page import HOW
from ddco_pyro.spec import PathSpec

ROWS = 6
"""Time lines that are seen at once."""

MOST_STEPS = 1_000_000
"""Steps of all levels in time lines, about; ``ddco-pyro segment --html`` makes a page of more."""


def section(fit: Fit, demos: Demonstrations, activity: Activity, paths: Sequence[PathSpec]) -> Section:
    """How each option is used, and the paths in space."""
    drawn = trajectories.picture(fit, demos, activity, paths)
    used = note("On the most likely path of all demonstrations. The same option chosen anew stays one segment.")
    blocks: list[Block] = [] if drawn is None else [drawn]
    if len(fit.names) > 1:
        named = " Legends give the names of the highest level first." if fit.named else ""
        apart = f"Each level numbers its own options: equal colours in two levels mean nothing.{named}"
        blocks.insert(0, Text(apart))
    blocks.append(Text("Use of the options", "heading"))
    blocks.append(use_table(fit))
    link = Markup('<a href="#segments">segments of every demonstration</a>')
    blocks += [used, Text(Markup("Step by step: {}.").format(link))]
    return Section("options", "How the options are used", blocks, folded=True)


def use_table(fit: Fit) -> Table:
    """The use of each choice of each level, the highest level first; control only where it is chosen."""
    rows, stands_for = [], {(one.level, one.option): agreeing(one) for one in fit.metrics.named_by_labels}
    for (level, names), use in reversed(list(zip(fit.names.items(), fit.metrics.options, strict=True))):
        total = sum(row.steps for row in use)
        for row in use:
            if row.choice or row.segments:
                named = Cell(numbered_name(row.choice, names), colour=option_colour(row.choice))
                length = "–" if row.length is None else duration(fit.metrics.control_frequency, row.length)
                label = [stands_for.get((level, row.choice), "–")] if stands_for else []
                rows.append([level, named, percent(row.steps / total, 1), str(row.segments), length, *label])
    head = ["Level", "Option", "Share of steps", "Segments", "Median length"]
    return Table([*head, *(["Label, agreement"] if stands_for else [])], rows, {0, 1, 5})


def agreeing(one: NamedByLabel) -> str:
    """The label that an option stands for, with their agreement: ``reach 0.71``."""
    return f"{one.name} {number(one.agreement)}"


def quoted(names: Mapping[str, Any] | Sequence[str]) -> str:
    """``label “phase” and “grasp”``."""
    return "label " + " and ".join(f"“{name}”" for name in names)


# --- segments ---------------------------------------------------------------------------------------------------------


def segments(drawn: Timelines, demonstrations: int) -> Section:
    """The time lines; a note on the others where not all of so many demonstrations have one."""
    explained = Markup('{} The order is that of the <a href="#demonstrations">list</a>.').format(HOW)
    blocks: list[Block] = [note(explained), replace(drawn, rows=ROWS)]
    if len(drawn.tracks) < demonstrations:
        command = Markup("<code>ddco-pyro segment RUN FILE --html PAGE</code>")
        blocks.append(note(Markup("The others would make this page slow; {} makes a page of them.").format(command)))
    return Section("segments", "Segments of every demonstration", blocks)
