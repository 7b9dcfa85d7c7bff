"""Segments as one self-contained HTML page: how options are used, and the timeline of every demonstration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.files import write_text
from ddco_pyro.drawing import scores as measures
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.templates import render
from ddco_pyro.drawing.words import option_name
from ddco_pyro.segmenting import Segmented
from ddco_pyro.segmenting.scores import LevelScores
from ddco_pyro.segmenting.timeline import duration, timelines


def write_page(path: Path, segmented: Segmented, run: str, file: str, scores: Mapping[str, LevelScores]) -> None:
    """Write the page, whole or not at all; whatever comes from files is escaped.

    :param scores: measures of each level's agreement with labels.
    """
    page = {
        "run": run,
        "file": file,
        "levels": [_level(name, count, segmented) for name, count in segmented.counts.items()],
        "scores": scores,
        "score_head": measures.HEAD,
        "explained": measures.EXPLAINED,
        "demonstrations": timelines(segmented),
        "held_out": sum(demo.held_out for demo in segmented.segments),
        "longest": duration(max(len(demo) for demo in segmented.segments), segmented.frequency),
    }
    write_text(path, render("segmenting/page.html.j2", page))


def _level(name: str, count: int, segmented: Segmented) -> dict[str, Any]:
    """How much of the time each option of a level takes, how often, and for how long."""
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
    return {"name": name, "options": options}
