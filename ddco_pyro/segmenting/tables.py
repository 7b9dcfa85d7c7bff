"""Segments as a table with a row for each step, in CSV or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from ddco_pyro.data.files import whole_file
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented

FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""How a text begins that a spreadsheet takes for a formula, and may execute."""


def cell(value: Any) -> Any:
    """A value as CSV has it: a text that a spreadsheet would execute begins with an apostrophe."""
    return f"'{value}" if isinstance(value, str) and value.startswith(FORMULA) else value


def columns(segmented: Segmented) -> list[str]:
    """Names of the columns: for each level its option, whether it was chosen anew, and how probable it is."""
    levels = [f"{name}{suffix}" for name in segmented.counts for suffix in ("", "_boundary", "_probability")]
    return ["demonstration", "step", *(["seconds"] if segmented.frequency else []), *levels]


def rows(segmented: Segmented) -> Iterator[list[Any]]:
    """A row for each step of each demonstration."""
    for demo in segmented.segments:
        for step in range(len(demo)):
            row: list[Any] = [demo.name, step, *([step / segmented.frequency] if segmented.frequency else [])]
            for level in demo.levels.values():
                row += [int(level.options[step]), int(level.boundaries[step]), float(level.probability[step])]
            yield row


def write_csv(path: Path, segmented: Segmented) -> None:
    """Write the table as CSV, whole or not at all; texts as :func:`cell` has them."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        for row in chain([columns(segmented)], rows(segmented)):
            writer.writerow(map(cell, row))


def write_parquet(path: Path, segmented: Segmented) -> None:
    """Write the table as Parquet, whole or not at all.

    :raises BadInput: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise BadInput("--parquet needs pyarrow; install it with: pip install 'ddco-pyro[lerobot]'") from None
    values = zip(*rows(segmented), strict=True)
    table = pyarrow.table({name: list(column) for name, column in zip(columns(segmented), values, strict=True)})
    with whole_file(path) as temporary:
        parquet.write_table(table, temporary)
