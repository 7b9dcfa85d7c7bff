"""Studies by scripts: cells are kept as those of a declaration, and tidy tables get their numbers."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from ddco_pyro.cli.console import Progress
from ddco_pyro.data.files import only_one, write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.jobs import Workers
from studies import cells
from studies.page import RESULTS
from studies.statistics import COLUMNS, read_tidy


class Row(NamedTuple):
    """A number. ``demonstrations`` and ``seed`` are None where a number has none; a seed may be a fold."""

    study: str
    task: str
    method: str
    demonstrations: int | None
    seed: int | str | None
    measure: str
    value: float


def add(path: Path, rows: Iterable[Row]) -> None:
    """Write rows into a table, in place of those of the same cell and measure; other processes may, too."""
    text = [(*("" if part is None else str(part) for part in row[:-1]), row[-1]) for row in rows]
    with only_one(path.parent, wait=True):
        tables = [read_tidy(path)] if path.exists() else []
        table = pd.concat([*tables, pd.DataFrame(text, columns=COLUMNS)])
        table = table.groupby(COLUMNS[:-1], sort=False, as_index=False).last()
        write_text(path, table.to_csv(index=False, lineterminator="\n", float_format="%.9g"))


@dataclass(frozen=True)
class Settings:
    """What all cells of a study share: numbers that decide a result, by their option's name, and a folder."""

    values: Mapping[str, float]
    runs: Path


class Cell(ABC):
    """A cell of a study. Each study has a dataclass of its own, whose fields name a cell."""

    name: str
    """Of its files."""

    @abstractmethod
    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Do the work; ``folder`` keeps the fits.

        :raises Failed: the simulator cannot be used, or its expert fails.
        """

    @abstractmethod
    def rows(self, results: Mapping[str, Any]) -> Iterable[Row]:
        """Its numbers in the study's table."""

    def depends(self, settings: Settings) -> dict[str, Any]:
        """What decides its results; the place of the data does not."""
        fields = asdict(self)  # type: ignore[call-overload]
        return {key: value for key, value in fields.items() if key != "data"} | dict(settings.values)

    def path(self, settings: Settings) -> Path:
        """Its file; other settings have other files."""
        digest = hashlib.sha256(json.dumps(dict(settings.values)).encode()).hexdigest()[:8]
        return settings.runs / "cells" / f"{self.name}-{digest}.json"

    def do(self, settings: Settings) -> str:
        """Do it, unless it is done; returns why it failed."""

        def work(folder: Path) -> dict[str, Any]:
            return {"values": self.results(settings, folder / "fit")}

        return cells.do(self.path(settings), self.depends(settings), work)

    def kept(self, settings: Settings) -> dict[str, Any] | None:
        """Its results; None where they are missing."""
        done = cells.kept(self.path(settings), self.depends(settings))
        return None if done is None or done.failed else done.values


def described(text: str | None) -> argparse.ArgumentParser:
    """A parser whose help is a script's docstring."""
    return argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)


def printed(work: Callable[[], str]) -> None:
    """Print what work gives, or end with the line that says why it cannot be done: with 2 for bad input."""
    try:
        print(work())
    except (BadInput, Failed) as error:
        print(error, file=sys.stderr)
        raise SystemExit(2 if isinstance(error, BadInput) else 1) from None


def main(
    table: str,
    parser: argparse.ArgumentParser,
    defaults: Settings,
    asked: Callable[[argparse.Namespace], Sequence[Cell]],
    first: Callable[[Settings], object] = lambda settings: None,
) -> None:
    """Do the cells of a study that are not done, and write the rows of every one that is.

    :param table: ``docs/results/TABLE.csv``.
    :param parser: has the options that ``asked`` reads.
    :param defaults: the study's settings where nothing else is said.
    :param first: is called before any cell, such as to make a simulator's environment.
    """
    for name, value in defaults.values.items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    parser.add_argument("--runs", type=Path, default=defaults.runs)
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time; each works on one thread")
    parser.add_argument("--out", type=Path, default=RESULTS / f"{table}.csv")
    own = parser.parse_args()

    def work() -> str:
        settings = Settings({name: getattr(own, name) for name in defaults.values}, own.runs)
        wanted = [*asked(own)]
        if not wanted:
            why = "there is nothing to do: a list or a number is empty or 0"
            raise BadInput(f"{Path(sys.argv[0]).name}: {why}")
        first(settings)
        calls = {cell.name: partial(cell.do, settings) for cell in wanted if cell.kept(settings) is None}
        with Progress() as progress:
            cells.do_all(calls, len(wanted) - len(calls), Workers(own.jobs), progress)
        done = {cell: found for cell in wanted if (found := cell.kept(settings)) is not None}
        add(own.out, [row for cell, found in done.items() for row in cell.rows(found)])
        if len(done) < len(wanted):
            failed = f"{len(wanted) - len(done)} of {len(wanted)} cells failed"
            raise Failed(f"{failed}; the same command tries them again")
        return f"{own.out}: has the numbers of {len(done)} cells"

    printed(work)
