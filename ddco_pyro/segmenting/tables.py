"""Segments as a table with a row for each step, in CSV or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ddco_pyro.data.files import whole_file
from ddco_pyro.errors import BadInput
from ddco_pyro.segmenting import Segmented


def columns(found: Segmented) -> list[str]:
    """Names of the columns: for each level its option, whether it was chosen anew, and how probable it is."""
    levels = [f"{name}{suffix}" for name in found.counts for suffix in ("", "_boundary", "_probability")]
    return ["demonstration", "step", *(["seconds"] if found.frequency else []), *levels]


def rows(found: Segmented) -> Iterator[list[Any]]:
    """A row for each step of each demonstration."""
    for one in found.segments:
        for step in range(len(one)):
            row: list[Any] = [one.name, step, *([step / found.frequency] if found.frequency else [])]
            for level in one.levels.values():
                row += [int(level.options[step]), int(level.boundaries[step]), float(level.probability[step])]
            yield row


def write_csv(path: Path, found: Segmented) -> None:
    """Write the table as CSV, whole or not at all."""
    with whole_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns(found))
        writer.writerows(rows(found))


def write_parquet(path: Path, found: Segmented) -> None:
    """Write the table as Parquet, whole or not at all.

    :raises BadInput: pyarrow is not installed.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise BadInput("--parquet needs pyarrow; install it with: pip install 'ddco-pyro[lerobot]'") from None
    values = zip(*rows(found), strict=True)
    table = pyarrow.table({name: list(column) for name, column in zip(columns(found), values, strict=True)})
    with whole_file(path) as temporary:
        parquet.write_table(table, temporary)
