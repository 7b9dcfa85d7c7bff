"""A study of cells: those that are not done are done, some at a time, and its table gets their numbers."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from cells import Cell, Settings, printed, some
from joblib import Parallel, delayed
from table import RESULTS, add, shown


def main(
    table: str,
    parser: argparse.ArgumentParser,
    defaults: Settings,
    cells: Callable[[argparse.Namespace], Sequence[Cell]],
    first: Callable[[Settings], object] = lambda settings: None,
) -> None:
    """Run a study as the command line says, and print its means.

    :param table: ``docs/results/TABLE.csv``.
    :param parser: has the options that ``cells`` reads.
    :param defaults: the study's settings where nothing else is said.
    :param first: is called before any cell, such as to make a simulator's environment.
    """
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time; each works on one thread")
    parser.add_argument("--summarize", action="store_true", help="do nothing that is not done")
    parser.add_argument("--out", type=Path, default=RESULTS / f"{table}.csv")
    defaults.add_to(parser)
    own = parser.parse_args()
    printed(lambda: run(own, defaults, cells, first))


def run(
    own: argparse.Namespace,
    defaults: Settings,
    cells: Callable[[argparse.Namespace], Sequence[Cell]],
    first: Callable[[Settings], object],
) -> str:
    """Do what is not done yet, and write the rows of every cell that is done; their means.

    :raises BadInput: there is no cell to do.
    """
    settings, asked = defaults.given(own), some(list(cells(own)))
    if not own.summarize:
        first(settings)
        Parallel(n_jobs=own.jobs, verbose=10)(delayed(cell.run)(settings) for cell in asked)
    done = [cell for cell in asked if cell.path(settings).exists()]
    rows = [row for cell in done for row in cell.rows(cell.run(settings))]
    add(own.out, rows)
    return shown(rows)
