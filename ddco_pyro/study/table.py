"""Tidy tables of results: a number in each row, which a task, a method and a training seed name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import BadInput
from ddco_pyro.study.declaration import Study

COLUMNS = ["study", "task", "method", "demonstrations", "seed", "measure", "value"]
"""All but ``value`` are text. ``demonstrations`` is empty where a number does not depend on them. ``seed`` may name
other repetitions, and is empty where there is one value."""

CELL = ["task", "method", "demonstrations", "seed"]
"""The columns that name a cell."""


def read_tidy(path: Path) -> pd.DataFrame:
    """A tidy table with :data:`COLUMNS`.

    :raises BadInput: the file cannot be read.
    """
    remedy = "write it with: ddco-pyro study report"
    try:
        return pd.read_csv(path, dtype=str, keep_default_na=False)[COLUMNS].astype({"value": float})
    except OSError as error:
        raise BadInput(f"{path}: cannot be read: {error.strerror}; {remedy}") from error
    except (KeyError, ValueError) as error:
        raise Damaged(path, f"{type(error).__name__}: {' '.join(str(error).split())}", remedy) from error


def earlier(study: Study) -> pd.DataFrame:
    """The rows of a declaration's tables ``kept``, by the names of the declaration.

    Rows of other cells, and of several seeds together, are left out. The first of several values decides.
    """
    seeds = [str(seed) for block in study.declared.ranges("seeds").values() for seed in block]
    tables = [pd.DataFrame(columns=COLUMNS)]
    for kept in study.declared.kept:
        table = read_tidy(study.path.parent / kept.table)
        table = table[table.seed.isin(seeds) & table.study.isin([kept.study] if kept.study else table.study)]
        table = table[table.method.isin(kept.methods.values() if kept.methods else table.method)]
        names = {"task": kept.tasks, "method": kept.methods, "measure": kept.measures}
        names_here = {column: {there: here for here, there in own.items()} for column, own in names.items()}
        table = table.replace(names_here).assign(study=study.name)
        tables.append(table[table.task.isin(study.tasks)])
    return pd.concat(tables).drop_duplicates([*CELL, "measure"]).astype({"value": float})


def values(
    table: pd.DataFrame, what: str, measure: str, demonstrations: Sequence[str | int], task: str | None = None
) -> pd.Series:
    """The values of a method, or the paired differences of ``ours - theirs``, indexed by ``task`` and ``seed``.

    :param demonstrations: of a method; a second number is that of ``theirs``.
    """
    table = table[(table.measure == measure) & table.task.isin(table.task if task is None else [task])]

    def of(method: str, count: str | int) -> pd.Series:
        rows = table[(table.method == method.strip()) & (table.demonstrations == str(count))]
        return rows.groupby(["task", "seed"], sort=False).value.last()

    found = of(what, demonstrations[0])
    if found.empty and " - " in what:
        ours, _, theirs = what.partition(" - ")
        found = (of(ours, demonstrations[0]) - of(theirs, demonstrations[-1])).dropna()
    seeds = found.index.get_level_values("seed")
    return found[(seeds != "") | (seeds == "").all()]  # a row without seed is the summary of the others
