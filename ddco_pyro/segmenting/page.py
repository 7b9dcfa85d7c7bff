"""Segments on a page: how each option is used, and the time line of every demonstration."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import accumulate, islice
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ddco_pyro.data.arrays import Observed
from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.data.files import write_text
from ddco_pyro.data.labels import BOUNDARY, SOURCE, SOURCES, UNKNOWN
from ddco_pyro.drawing.page import Block, Cell, Page, Section, Table, Text, footnote, note
from ddco_pyro.drawing.timeline import Timelines, coded, following
from ddco_pyro.drawing.words import NAT, duration, number, percent
from ddco_pyro.evaluation.agreement import EXPLAINED, agreement_table, tolerances
from ddco_pyro.evaluation.options import on_paths
from ddco_pyro.names import label_name, numbered_name, option_colour, option_name
from ddco_pyro.segmenting.segments import Segmented, Segments
from ddco_pyro.spec import PathSpec

HOW = (
    "Time runs to the right. Colours are options; the height of a band is the posterior probability of its "
    "option. A bar below a boundary is the 90 % interval of its step, over draws from the posterior. Rows "
    "without such bands are labels: each has the colour of the option that it is matched with, or is grey. "
    "Numbers, paths and pictures below follow the cursor."
)


def write_page(path: Path, segmented: Segmented, run: str, file: str, drawn: Timelines) -> None:
    """Write the page, whole or not at all.

    :param drawn: of :func:`timelines`.
    """
    count, held_out = len(segmented), sum(demo.held_out for demo in segmented.segments)
    which = f"{held_out} of {count} demonstrations"
    intro = f"{which} were held out when the run was fitted. They are marked “held out”."
    sections = [_level(name, segmented) for name in segmented.counts]
    nats = f"Nats per step: the log-likelihood of the demonstration's controls under the model; {NAT}."
    sections.append(Section("segments", "Every demonstration", [note(f"{HOW} {nats}"), drawn]))
    page = Page(file, [Text(intro)] if held_out else [], sections, subtitle=f"segmented by {run}")
    write_text(path, page.html())


def _level(name: str, segmented: Segmented) -> Section:
    """How much of the time each option of a level takes, how often, and for how long."""
    paths, rows = [demo.levels[name].options for demo in segmented.segments], []
    total = sum(map(len, paths))
    for option, (lengths, having, _) in enumerate(on_paths(paths, segmented.counts[name])):
        if option or having:
            named = Cell(numbered_name(option, segmented.names.get(name, ())), colour=option_colour(option))
            median = duration(segmented.frequency, float(np.median(lengths))) if having else "–"
            share = percent(float(lengths.sum()) / total, 1)
            rows.append([named, share, str(len(lengths)), median, f"{having} of {len(segmented)}"])
    head = ["Option", "Share of steps", "Segments", "Median length", "Demonstrations with it"]
    blocks: list[Block] = [Table(head, rows), *use_by_task(segmented, name)]
    if scores := segmented.agreements.get(name):
        blocks.append(Text(f"Agreement with the label “{segmented.truth[name]}”", "heading"))
        blocks += [agreement_table(scores), footnote(f"{EXPLAINED} {tolerances(segmented.frequency)}")]
    return Section(f"level-{quote(name, safe='')}", f"Level “{name}”", blocks)


def use_by_task(segmented: Segmented, level: str) -> list[Block]:
    """A table of the share of each task's steps that is in each option of a level; none of a single task."""
    steps: dict[str, list[np.ndarray]] = {}
    for demo in segmented.segments:
        steps.setdefault(demo.task, []).append(demo.levels[level].options)
    if len(steps) < 2:
        return []
    tasks, names = sorted(steps), segmented.names.get(level, ())
    used = {task: np.concatenate(steps[task]) for task in tasks}
    rows = []
    for option in range(segmented.counts[level] + 1):
        shares = [float((used[task] == option).mean()) for task in tasks]
        if option or any(shares):
            named = Cell(numbered_name(option, names), colour=option_colour(option))
            rows.append([named, *(percent(share) if share else "" for share in shares)])
    head = ["Option", *(task or "no task" for task in tasks)]
    return [Text("Options in tasks", "heading"), Table(head, rows)]


def anchor(name: str) -> str:
    """The ``id`` of a demonstration's timeline, the same on every page; it needs no quoting in an address."""
    return "segments-" + quote(name, safe="").replace("%", ".")


def timelines(
    segmented: Segmented,
    demos: Iterable[Demonstration],
    pictures: Sequence[Observed],
    paths: Sequence[PathSpec],
    most_steps: float = math.inf,
) -> Timelines:
    """Time lines of the first demonstrations: about ``most_steps`` steps of all levels, at least one of them.

    :param demos: in the order of their segments; their numbers, paths and pictures follow the cursor.
    :param pictures: of each demonstration; empty for none.
    """
    lanes: dict[str, tuple[Any, Any]] = {}  # the names and the colours of values
    for name, count in reversed(segmented.counts.items()):
        names = [option_name(choice, segmented.names.get(name, ())) for choice in range(count + 1)]
        with_open = dict(enumerate(names)) | {UNKNOWN: SOURCES[0]}
        known = with_open if name + SOURCE in segmented.label_names else names
        lanes[name] = known, list(map(option_colour, range(count + 1)))
    for name, words in _values(segmented).items():
        matched = segmented.matched.get(name, {}).items()
        lanes[name] = words, {label: option_colour(option) for label, option in matched}
    before = accumulate((len(demo) * len(segmented.counts) for demo in segmented.segments), initial=0)
    shown = [demo for demo, steps in zip(segmented.segments, before, strict=False) if steps < most_steps]
    steps = min(sum(map(len, segmented.segments)), most_steps / len(segmented.counts))
    follows = following(islice(demos, len(shown)), pictures[: len(shown)], int(steps), paths)
    tracks = [
        {
            "name": demo.name,
            "anchor": anchor(demo.name),
            "facts": f"{demo.task and f'{demo.task}, '}{duration(segmented.frequency, len(demo))}, "
            f"{number(demo.log_likelihood)} nats/step",
            "held_out": demo.held_out,
            "steps": len(demo),
            "lanes": [_runs(demo, name) for name in lanes],
            **follow,
        }
        for demo, follow in zip(shown, follows, strict=True)
    ]
    rows = [{"name": name, "names": names, "colours": colours} for name, (names, colours) in lanes.items()]
    return Timelines(rows, tracks, segmented.frequency)


def _values(segmented: Segmented) -> dict[str, dict[int, str]]:
    """The labels of demonstrations and who says so, and the name of each of their values."""
    found: dict[str, dict[int, str]] = {}
    for demo in segmented.segments:
        for name, values in (demo.labels | demo.sources).items():
            if name not in segmented.counts and not name.endswith(BOUNDARY):
                known = segmented.label_names.get(name, ())
                found.setdefault(name, {}).update(
                    (value, label_name(name, value, known)) for value in np.unique(values).tolist()
                )
    return found


def _runs(demo: Segments, name: str) -> dict[str, Any] | None:
    """The segments of a demonstration in a lane; None where the demonstration lacks it."""
    if level := demo.levels.get(name):
        options, starts, _ = zip(*level.runs(), strict=True)
        return coded(starts, options, level.intervals, level.probability)
    values = demo.labels.get(name, demo.sources.get(name))
    if values is None:
        return None
    found = np.flatnonzero(np.diff(values, prepend=values[0] - 1))
    return coded(found.tolist(), values[found].tolist())
