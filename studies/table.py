"""The tidy table of a study: a number in each row, under ``docs/results``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from ddco_pyro.data.files import only_one, write_text
from ddco_pyro.drawing.page import Table
from ddco_pyro.study.report import shown as mean_and_interval
from ddco_pyro.study.statistics import estimate
from ddco_pyro.study.table import COLUMNS, read_tidy

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"


class Row(NamedTuple):
    """A number. ``demonstrations`` and ``seed`` are None where a number has none; a seed may be a fold."""

    study: str
    task: str
    method: str
    demonstrations: int | None
    seed: int | str | None
    measure: str
    value: float


def tidy(rows: Iterable[Row]) -> pd.DataFrame:
    """The rows as :func:`ddco_pyro.study.table.read_tidy` reads them."""
    text = [(*("" if part is None else str(part) for part in row[:-1]), row[-1]) for row in rows]
    return pd.DataFrame(text, columns=COLUMNS)


def add(path: Path, rows: Iterable[Row]) -> None:
    """Write rows into a table, in the place of those of the same cell and measure; another process may do so too."""
    with only_one(path.parent, wait=True):
        tables = [read_tidy(path)] if path.exists() else []
        table = pd.concat([*tables, tidy(rows)]).groupby(COLUMNS[:-1], sort=False, as_index=False).last()
        write_text(path, table.to_csv(index=False, lineterminator="\n", float_format="%.9g"))


def shown(rows: Iterable[Row]) -> str:
    """Means over seeds with 95 % t intervals, as Markdown: a line for each method and number of demonstrations."""
    table, lines = tidy(rows), []
    measures = table.measure.unique()
    for named, cells in table.groupby(COLUMNS[:4], sort=False):
        by_measure = dict(iter(cells.set_index(["task", "seed"]).groupby("measure").value))
        means = {measure: mean_and_interval(estimate(own), ".3g") for measure, own in by_measure.items()}
        lines.append([*named, *(means.get(measure, "-") for measure in measures)])
    return Table([*COLUMNS[:4], *measures], lines, range(4)).markdown() + "\n"
