"""Segments as one self-contained HTML page: how options are used, and the timeline of every demonstration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.templates import render
from ddco_pyro.fitting.analysis import agreement
from ddco_pyro.segmenting import Segmented, Segments
from ddco_pyro.segmenting.timeline import duration, option_name, timelines


def write_page(path: Path, found: Segmented, run: str, file: str) -> None:
    """Write the page, whole or not at all; whatever comes from files is escaped."""
    page = {
        "run": run,
        "file": file,
        "levels": [_level(name, count, found) for name, count in found.counts.items()],
        "truth": found.truth,
        "demonstrations": timelines(found),
        "held_out": sum(one.held_out for one in found.segments),
        "longest": duration(max(len(one) for one in found.segments), found.frequency),
    }
    write_text(path, render("segmenting/page.html.j2", page))


def _level(name: str, count: int, found: Segmented) -> dict[str, Any]:
    """How much of the time each option of a level takes, how often, and for how long; its agreement with the labels."""
    runs = [run for one in found.segments for run in one.levels[name].runs()]
    total = sum(end - start for _, start, end in runs)
    options = []
    for option in range(count + 1):
        lengths = [end - start for choice, start, end in runs if choice == option]
        if option or lengths:
            typical = float(np.median(lengths)) if lengths else None
            options.append(
                {
                    "name": option_name(option),
                    "colour": option_colour(option),
                    "share": f"{sum(lengths) / total:.1%}",
                    "segments": len(lengths),
                    "length": "-" if typical is None else duration(typical, found.frequency),
                    "in": sum(any(c == option for c, _, _ in one.levels[name].runs()) for one in found.segments),
                }
            )
    return {"name": name, "options": options, "agreement": _agreement(name, found)}


def _agreement(level: str, found: Segmented) -> str:
    """A level's normalised mutual information with the labels that the run's spec names; empty where there are none."""
    labelled = [one for one in found.segments if found.truth in one.labels]
    groups = {
        "held-out": [one for one in labelled if one.held_out],
        "other": [one for one in labelled if not one.held_out],
    }
    if not groups["held-out"]:
        groups = {"": labelled}
    return " and ".join(
        f"{_mutual_information(level, found.truth, group):.2f} on {f'{len(group)} {kind}'.strip()} demonstrations"
        for kind, group in groups.items()
        if found.truth and group
    )


def _mutual_information(level: str, truth: str, group: list[Segments]) -> float:
    return agreement([one.levels[level].options for one in group], [one.labels[truth] for one in group])
