"""Segments on a page: how each option is used, and the timeline of every demonstration."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.page import Block, Cell, Page, Section, Strip, Table, Text, Timeline, note
from ddco_pyro.drawing.words import NAT, number, numbered_name, option_name
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments
from ddco_pyro.segmenting.agreement import EXPLAINED, LevelAgreement, agreement_table

SHADES = ("#f2f2f2", "#d4d4d4")
"""Shades of ground-truth segments, in turn: colours belong to options."""

ROOM = 0.03
"""A segment carries its number if it is longer than this share of the longest demonstration."""

LETTER = 0.011
"""The share of the longest demonstration that a letter of a name takes."""


def write_page(path: Path, segmented: Segmented, run: str, file: str, agreements: Mapping[str, LevelAgreement]) -> None:
    """Write the page, whole or not at all.

    :param agreements: agreement of each level with labels.
    """
    count, held_out = len(segmented), sum(demo.held_out for demo in segmented.segments)
    longest = duration(max(len(demo) for demo in segmented.segments), segmented.frequency)
    intro = f"{held_out} of {count} demonstrations were held out when the run was fitted. They are marked “held out”."
    sections = [_level(name, segmented, agreements.get(name)) for name in segmented.counts]
    drawn = note(
        f"Time runs to the right on one scale; the full width is {longest}. Colours are options; a white line is a new "
        "choice. Grey rows are labels in the file and baselines. Rest the pointer on a segment for its steps and its "
        f"probability. Nats per step: the log-likelihood of the demonstration's controls under the model; {NAT}."
    )
    sections.append(Section("segments", "Every demonstration", [drawn, *timelines(segmented)]))
    page = Page(file, [Text(intro)] if held_out else [], sections, subtitle=f"segmented by {run}")
    write_text(path, page.html())


def _level(name: str, segmented: Segmented, agreement: LevelAgreement | None) -> Section:
    """How much of the time each option of a level takes, how often, and for how long."""
    per_demo = [demo.levels[name].runs() for demo in segmented.segments]
    runs = [run for each in per_demo for run in each]
    total = sum(end - start for _, start, end in runs)
    rows = []
    for option in range(segmented.counts[name] + 1):
        lengths = [end - start for choice, start, end in runs if choice == option]
        if option or lengths:
            named = Cell(numbered_name(option, segmented.names.get(name, ())), colour=option_colour(option))
            median = duration(float(np.median(lengths)), segmented.frequency) if lengths else "–"
            there = sum(any(choice == option for choice, _, _ in each) for each in per_demo)
            used = [f"{sum(lengths) / total:.1%}", str(len(lengths)), median]
            rows.append([named, *used, f"{there} of {len(segmented)}"])
    head = ["option", "of all steps", "segments", "median length", "in demonstrations"]
    blocks: list[Block] = [Table(head, rows)]
    if agreement:
        blocks.append(Text(f"Agreement with the label “{agreement.labels}”", "heading"))
        blocks += [agreement_table(agreement.scores), note(EXPLAINED)]
    return Section(f"level-{quote(name, safe='')}", f"Level “{name}”", blocks)


def anchor(name: str) -> str:
    """The ``id`` of a demonstration's timeline, the same on every page; it needs no quoting in an address."""
    return "segments-" + quote(name, safe="").replace("%", ".")


def duration(steps: float, frequency: float | None) -> str:
    """``61 steps``, with seconds where the frequency (Hz) is known."""
    return f"{steps:g} steps" + (f", {steps / frequency:.3g} s" if frequency else "")


def timelines(segmented: Segmented, most_segments: float = math.inf) -> list[Timeline]:
    """Timelines of the first demonstrations on one scale: about ``most_segments`` segments, at least one of them."""
    counts = [sum(len(level.runs()) for level in demo.levels.values()) for demo in segmented.segments]
    before = accumulate(counts, initial=0)
    shown = [demo for demo, count in zip(segmented.segments, before, strict=False) if count < most_segments]
    longest = max(len(demo) for demo in shown)
    return [
        Timeline(
            demo.name,
            anchor(demo.name),
            f"{duration(len(demo), segmented.frequency)}, {number(demo.log_likelihood)} nats/step",
            demo.held_out,
            list(_rows(demo, segmented, longest)),
        )
        for demo in shown
    ]


def _rows(demo: Segments, segmented: Segmented, longest: int) -> Iterator[tuple[str, list[Strip]]]:
    """The levels, the highest first, the baselines and the labels of a demonstration."""
    for name, level in reversed(demo.levels.items()):
        names = segmented.names.get(name, ())
        yield name, [_option(level, run, names, segmented.frequency, longest) for run in level.runs()]
    for name, values in {**demo.labels, **demo.baselines}.items():
        if name not in demo.levels and not name.endswith("_boundary"):
            yield name, list(_labels(name, values, longest))


def _option(
    level: LevelLabels, run: tuple[int, int, int], names: Sequence[str], frequency: float | None, longest: int
) -> Strip:
    option, start, end = run
    seconds = f" ({start / frequency:.3g} to {end / frequency:.3g} s)" if frequency else ""
    probability = float(level.probability[start:end].mean())
    name = option_name(option, names)
    title = f"{name}, steps {start} to {end - 1}{seconds}, probability {probability:.2f}"
    short = name == option_name(option) or end - start < LETTER * len(name) * longest
    text = (str(option) if short else name) if option else ""
    return _strip(start, end, longest, option_colour(option), text, title)


def _labels(name: str, values: np.ndarray, longest: int) -> Iterator[Strip]:
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    for place, (start, end) in enumerate(pairwise(edges)):
        value = str(values[start])
        yield _strip(start, end, longest, SHADES[place % 2], value, f"{name} {value}, steps {start} to {end - 1}")


def _strip(start: int, end: int, longest: int, colour: str, text: str, title: str) -> Strip:
    from matplotlib.colors import to_rgb  # most commands draw no page

    shown = text if end - start > ROOM * longest else ""
    red, green, blue = to_rgb(colour)
    ink = "#000" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "#fff"  # the one that can be read
    return Strip(f"{100 * start / longest:.3f}", f"{100 * (end - start) / longest:.3f}", colour, ink, shown, title)
