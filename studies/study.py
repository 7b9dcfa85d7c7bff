"""A study with a simulator apart: its cells are done, some at a time, and what they say together is written."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from apart import Apart
from cells import Cell, Settings, printed, some
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text


class Shown(Protocol):
    """A module that says what cells say together."""

    def summarize(self, cells: list[dict[str, Any]]) -> Any:
        """Every measure over training seeds."""
        ...

    def page(self, summary: Any, made_by: str) -> str:
        """A summary as Markdown."""
        ...

    def draw(self, summary: Any, path: Path) -> None:
        """A summary as a picture."""
        ...


@dataclass(frozen=True)
class Study:
    """Cells over tasks and training seeds.

    :param name: its script is ``NAME.py``, its results are in ``docs/results/NAME``.
    :param axes: the options that say which cells there are.
    :param cells: from them.
    :param simulator: that cells of these settings need.
    :param defaults: its settings where nothing else is said.
    :param jobs: cells at a time where nothing else is said.
    """

    name: str
    axes: tuple[str, ...]
    cells: Callable[[argparse.Namespace], list[Cell]]
    simulator: Callable[[Settings], Apart]
    shown: Shown
    defaults: Settings
    jobs: int

    def main(self, parser: argparse.ArgumentParser) -> None:
        """Run it as the command line says.

        :param parser: has the axes' options.
        """
        parser.add_argument("--jobs", type=int, default=self.jobs, help="cells at a time; each works on one thread")
        parser.add_argument("--out", type=Path, default=Path("docs/results") / self.name)
        self.defaults.add_to(parser)
        own = parser.parse_args()
        printed(lambda: self.run(own))

    def run(self, own: argparse.Namespace) -> str:
        """Do what is not done yet, and write ``summary.json``, ``summary.md`` and ``NAME.png``; the page.

        :raises BadInput: there is no cell to do.
        """
        settings, cells = self.defaults.given(own), some(self.cells(own))
        made_by = record(cells[0].command(settings))
        self.simulator(settings).made()  # or nothing else has to begin
        kept = Parallel(n_jobs=own.jobs, verbose=10)(delayed(cell.run)(settings, made_by) for cell in cells)
        results = self.shown.summarize([content["results"] for content in kept])
        records = [content["provenance"][0] for content in kept]
        page = self.shown.page(results, sentence(self._command(own, settings), records))
        write_text(own.out / "summary.json", text(results, records))
        write_text(own.out / "summary.md", page)
        self.shown.draw(results, own.out / f"{self.name}.png")
        return page

    def _command(self, own: argparse.Namespace, settings: Settings) -> str:
        words = [f"python studies/{self.name}.py"]
        for axis in self.axes:
            value = getattr(own, axis)
            words.append(f"--{axis} {' '.join(map(str, value)) if isinstance(value, list) else value}")
        return " ".join([*words, settings.words()])
