"""Tables with a row for each step, in CSV and Parquet, and a page with the time line of every demonstration."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import chain, islice
from typing import Any

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import whole_file
from ddco_pyro.data.labels import BOUNDARY, SOURCE, UNKNOWN
from ddco_pyro.drawing.shown import paths_of, stored_pictures
from ddco_pyro.names import option_name
from ddco_pyro.segmenting import SOURCES, Segmented, recorded
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.page import followed, write_page

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of a text that a spreadsheet may execute as a formula."""


def cell(value: Any) -> Any:
    """A value for CSV: an apostrophe goes before a text that a spreadsheet would execute."""
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value


def columns(segmented: Segmented) -> list[str]:
    """Names of the columns: for each level the option, whether it is a new choice, probability, name; of baselines, and
    who says so.
    """
    levels = [f"{name}{suffix}" for name in segmented.counts for suffix in ("", BOUNDARY, "_probability", "_name")]
    return [
        "demonstration",
        "step",
        *(["seconds"] if segmented.frequency else []),
        *levels,
        *segmented.segments[0].baselines,
    ]


def rows(segmented: Segmented) -> Iterator[list[Any]]:
    """A row for each step of each demonstration."""
    for demo in segmented.segments:
        for step in range(len(demo)):
            row: list[Any] = [demo.name, step, *([step / segmented.frequency] if segmented.frequency else [])]
            for name, level in demo.levels.items():
                option = int(level.options[step])
                row += [option, int(level.boundaries[step]), float(level.probability[step])]
                row.append("" if option == UNKNOWN else option_name(option, segmented.names.get(name, ())))
            for name, kinds in demo.baselines.items():
                row.append(SOURCES[kinds[step]] if name.endswith(SOURCE) else int(kinds[step]))
            yield row


def write_csv(asked: Asked, segmented: Segmented) -> str:
    """The table as CSV."""
    with whole_file(asked.out) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        for row in chain([columns(segmented)], rows(segmented)):
            writer.writerow(map(cell, row))
    return str(asked.out)


def write_parquet(asked: Asked, segmented: Segmented) -> str:
    """The table as Parquet, with pyarrow."""
    import pyarrow
    from pyarrow import parquet

    values = zip(*rows(segmented), strict=True)
    table = pyarrow.table({name: list(column) for name, column in zip(columns(segmented), values, strict=True)})
    with whole_file(asked.out) as temporary:
        parquet.write_table(table, temporary)
    return str(asked.out)


FIRST = 10
"""Demonstrations among which an observation that moves like a position is sought."""


def write_html(asked: Asked, segmented: Segmented) -> str:
    """The page of :mod:`ddco_pyro.segmenting.page`."""
    pictures = stored_pictures(asked.source, {demo.name: len(demo) for demo in segmented.segments})
    demos = recorded(segmented, asked.fit, asked.source)
    first = list(islice(demos, FIRST))
    paths = paths_of(asked.fit.spec.report.trajectory, Demonstrations(tuple(first)))
    follows = followed(chain(first, demos), pictures, segmented, paths)
    write_page(asked.out, segmented, str(asked.run), str(asked.demos), follows)
    return str(asked.out)
