"""Tables with a row for each step, in CSV and Parquet, and a page with each demonstration's time line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.labels import BOUNDARY, SOURCES, UNKNOWN
from ddco_pyro.drawing.shown import stored_pictures
from ddco_pyro.names import option_name
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.page import timelines, write_page
from ddco_pyro.segmenting.segments import Segmented, recorded

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a text that a spreadsheet may execute as a formula."""


def table(segmented: Segmented) -> pandas.DataFrame:
    """A row for each step: of each level the option, whether it is a new choice, its probability and name.

    Then comes who says so, where a person labelled.
    """
    parts = []
    named = any(demo.task for demo in segmented.segments)
    for demo in segmented.segments:
        columns: dict[str, Any] = {"demonstration": demo.name}
        columns |= {"task": demo.task} if named else {}
        columns["step"] = np.arange(len(demo))
        if segmented.frequency:
            columns["seconds"] = columns["step"] / segmented.frequency
        for name, level in demo.levels.items():
            names = segmented.names.get(name, ())
            columns[name] = level.options
            columns[name + BOUNDARY] = level.boundaries.astype(int)
            columns[f"{name}_probability"] = level.probability.astype(float)
            words = {option: option_name(option, names) for option in level.options.tolist()} | {UNKNOWN: ""}
            columns[f"{name}_name"] = [words[option] for option in level.options.tolist()]
        columns |= {name: [SOURCES[place] for place in sources] for name, sources in demo.sources.items()}
        parts.append(pandas.DataFrame(columns))
    return pandas.concat(parts, ignore_index=True)


def write_csv(asked: Asked, segmented: Segmented) -> str:
    """The table as CSV; an apostrophe goes before a text that a spreadsheet would execute."""
    rows = table(segmented)
    for name in ("demonstration", *({"task"} & {*rows}), *(f"{level}_name" for level in segmented.counts)):
        rows[name] = [f"'{text}" if text.startswith(FORMULA) else text for text in rows[name]]
    with whole_file(asked.out) as temporary:
        rows.to_csv(temporary, index=False)
    return str(asked.out)


def write_parquet(asked: Asked, segmented: Segmented) -> str:
    """The table as Parquet."""
    with whole_file(asked.out) as temporary:
        table(segmented).to_parquet(temporary, engine="pyarrow", index=False)
    return str(asked.out)


def write_html(asked: Asked, segmented: Segmented) -> str:
    """The page of :mod:`ddco_pyro.segmenting.page`."""
    pictures = stored_pictures(asked.source, {demo.name: len(demo) for demo in segmented.segments})
    demos = recorded(segmented, asked.fit, asked.source)
    drawn = timelines(segmented, demos, pictures, asked.fit.spec.report.trajectory or ())
    write_page(asked.out, segmented, asked.fit.place, str(asked.source.path), drawn)
    return str(asked.out)
