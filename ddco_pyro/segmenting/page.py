"""Segments as one self-contained HTML page: how options are used, and the timeline of every demonstration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.templates import render
from ddco_pyro.drawing.words import option_name
from ddco_pyro.fitting.analysis import agreement
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.timeline import duration, timelines


def write_page(path: Path, segmented: Segmented, run: str, file: str) -> None:
    """Write the page, whole or not at all; whatever comes from files is escaped."""
    page = {
        "run": run,
        "file": file,
        "levels": [_level(name, count, segmented) for name, count in segmented.counts.items()],
        "truth": segmented.truth,
        "demonstrations": timelines(segmented),
        "held_out": sum(demo.held_out for demo in segmented.segments),
        "longest": duration(max(len(demo) for demo in segmented.segments), segmented.frequency),
    }
    write_text(path, render("segmenting/page.html.j2", page))


def _level(name: str, count: int, segmented: Segmented) -> dict[str, Any]:
    """How much of the time each option of a level takes, how often, and for how long; its agreement with the labels."""
    runs = [run for demo in segmented.segments for run in demo.levels[name].runs()]
    total = sum(end - start for _, start, end in runs)
    options = []
    for option in range(count + 1):
        lengths = [end - start for choice, start, end in runs if choice == option]
        if option or lengths:
            typical = float(np.median(lengths)) if lengths else None
            options.append(
                {
                    "name": option_name(option, segmented.option_labels.get(name)),
                    "colour": option_colour(option),
                    "share": f"{sum(lengths) / total:.1%}",
                    "segments": len(lengths),
                    "length": "-" if typical is None else duration(typical, segmented.frequency),
                    "in": sum(any(c == option for c, _, _ in demo.levels[name].runs()) for demo in segmented.segments),
                }
            )
    return {"name": name, "options": options, "agreement": _agreement(name, segmented)}


def _agreement(level: str, segmented: Segmented) -> str:
    """A level's normalised mutual information with the labels that the run's spec names; empty where there are none."""
    labelled = [demo for demo in segmented.segments if segmented.truth in demo.labels]
    groups = {
        "held-out": [demo for demo in labelled if demo.held_out],
        "other": [demo for demo in labelled if not demo.held_out],
    }
    if not groups["held-out"]:
        groups = {"": labelled}
    return " and ".join(
        f"{_mutual_information(level, segmented.truth, group):.2f} on {f'{len(group)} {kind}'.strip()} demonstrations"
        for kind, group in groups.items()
        if segmented.truth and group
    )


def _mutual_information(level: str, truth: str, group: list[Segments]) -> float:
    return agreement([demo.levels[level].options for demo in group], [demo.labels[truth] for demo in group])
