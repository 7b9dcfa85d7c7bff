"""Cells of a study: each is kept as JSON once it is done, and not done again with the same settings."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_type_hints

import torch
from table import Row
from threadpoolctl import threadpool_limits

from ddco_pyro.data.files import write_text
from ddco_pyro.errors import BadInput, Failed


@dataclass(frozen=True)
class Settings:
    """What all cells of a study share.

    :param values: numbers that decide a result, by the name of their option: a study has its own.
    :param runs: the folder of everything but the results.
    :param overrides: of the specs, each KEY=VALUE.
    """

    values: Mapping[str, float]
    runs: Path
    overrides: tuple[str, ...] = ()

    def kept(self) -> dict[str, Any]:
        """What decides a result."""
        return {**self.values, "overrides": list(self.overrides)}

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        """The arguments that :meth:`given` reads; these settings are their defaults."""
        for name, value in self.values.items():
            parser.add_argument(f"--{name}", type=type(value), default=value)
        parser.add_argument("--set", action="append", default=list(self.overrides), metavar="KEY=VALUE")
        parser.add_argument("--runs", type=Path, default=self.runs)

    def given(self, own: argparse.Namespace) -> Settings:
        """What was said of all cells."""
        values = {name: getattr(own, name) for name in self.values}
        return replace(self, values=values, runs=own.runs, overrides=tuple(own.set))


class Cell(ABC):
    """A cell of a study. Each study has a dataclass of its own, whose fields name a cell, also in its command."""

    script: ClassVar[str]
    """Its file in this folder."""

    @abstractmethod
    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Do the work; ``folder`` keeps the fits.

        :raises Failed: the simulator cannot be used, or its expert fails.
        """

    @abstractmethod
    def rows(self, results: Mapping[str, Any]) -> Iterable[Row]:
        """Its numbers in the study's table."""

    @property
    def name(self) -> str:
        """Of its files."""
        return "-".join(map(str, astuple(self)))

    def path(self, settings: Settings) -> Path:
        """Its JSON; other settings have other folders."""
        return settings.runs / "cells" / digest(settings.kept()) / f"{self.name}.json"

    def run(self, settings: Settings) -> dict[str, Any]:
        """Its results, as its JSON has them; nothing is done again.

        :raises Failed: as :meth:`results` does.
        """
        path = self.path(settings)
        folder = settings.runs / "fits" / path.parent.name / path.stem
        return kept(path, asdict(self) | settings.kept(), lambda: self.results(settings, folder))

    @classmethod
    def main(cls, text: str | None, defaults: Settings, **choices: Sequence[str]) -> None:
        """Run the cell that the command line names, a word for each field, and print its JSON.

        :param text: the help.
        :param choices: of a field, where not all are allowed.
        """
        parser, types = described(text), get_type_hints(cls)
        for field in fields(cls):
            parser.add_argument(field.name, type=types[field.name], choices=choices.get(field.name))
        defaults.add_to(parser)
        own = parser.parse_args()
        settings = defaults.given(own)
        words = [getattr(own, field.name) for field in fields(cls)]

        printed(lambda: json.dumps(cls(*words).run(settings), indent=1))


T = TypeVar("T")


def described(text: str | None) -> argparse.ArgumentParser:
    """A parser whose help is a script's docstring."""
    return argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)


def printed(work: Callable[[], str]) -> None:
    """Print what work gives, or end with the line that says why it cannot be done: with 2 where the input is bad."""
    try:
        print(work())
    except (BadInput, Failed) as error:
        print(error, file=sys.stderr)
        raise SystemExit(2 if isinstance(error, BadInput) else 1) from None


def some(cells: list[T]) -> list[T]:
    """What a study is to do: its cells, or training seeds.

    :raises BadInput: there are none.
    """
    if not cells:
        raise BadInput(f"{Path(sys.argv[0]).name}: there is nothing to do: a list or a number is empty or 0")
    return cells


def digest(settings: Mapping[str, Any]) -> str:
    """A folder's name for settings; others have others."""
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:8]


def kept(path: Path, settings: Mapping[str, Any], work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """A cell's results, as its JSON in ``path`` has them; ``work``, on one thread, is done only once.

    :param settings: what names the cell and decides its results; part of them.
    :raises ValueError: a result is named like a setting, which it would replace.
    """
    if path.exists():
        content: dict[str, Any] = json.loads(path.read_text())
        if all(content.get(key) == value for key, value in settings.items()):
            return content
    torch.set_num_threads(1)
    with threadpool_limits(1):
        results = work()
    if twice := sorted(settings.keys() & results.keys()):
        raise ValueError(f"{path}: results are named like settings: {', '.join(twice)}")
    write_text(path, json.dumps({**settings, **results}, indent=1) + "\n")
    return dict(json.loads(path.read_text()))
