"""Pushing from pictures (paper §5.1, SM 1.2, SM 1.5): goals against demonstrations, the same over the features of a
flat policy (``encoded``), of pictures as the camera has them beside small ones (``large``), goals against options, and
augmentation.

    python studies/pushing_pictures.py demonstrations|encoded|large|options|augmentation [--seeds 3]
        [--methods ff ff_flat ...] [--counts 80 40 20 10] [--options 1 2 3 4 5 6] [--updates 4000] [--episodes 5]
        [--set KEY=VALUE]... [--summarize] [--minutes 60] [--jobs 1] [--out DIR] [--runs DIR]

Does cells one seed after the other, and begins none after so many minutes; what this code has done with these settings
is not done again, and neither is what the JSON of this study, or of another in DIR, has of these settings, by whatever
code. Writes ``NAME.json``, ``NAME.md`` and ``NAME.png`` of all cells that are done, and says which are not.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pushing_pictures_results as shown
from cells import Settings, described, printed, some
from joblib import Parallel, delayed
from provenance import Record, record, sentence, text
from pushing_pictures_cell import DEFAULTS, METHODS, PictureCell, spec_of

from ddco_pyro.data.files import write_text

STUDIES = {
    "demonstrations": ("ff_flat", "ff", "rnn_flat", "rnn", "ff_two_flat", "ff_two"),
    "encoded": ("ff_flat", "encoded_flat", "encoded"),
    "large": ("ff_flat", "ff_large_flat", "ff", "ff_large"),
    "options": ("ff", "rnn"),
    "augmentation": ("ff", "ff_hybrid", "rnn", "rnn_hybrid"),
}
"""The methods of each."""

OWN_OPTIONS = {"ff": 2, "rnn": 4, "encoded": 2}
"""What the supplement says; the text has them the other way round."""

COUNT = 40
"""Demonstrations where their number is not what is varied."""

FIELDS = tuple(field.name for field in fields(PictureCell))
"""Of a row, what names its cell."""


def cells(own: argparse.Namespace) -> list[PictureCell]:
    """All of a study, one seed after the other."""
    methods = [name for name in STUDIES[own.study] if name in own.methods]
    if shown.ACROSS[own.study] == "count":
        product = itertools.product(range(own.seeds), own.counts, methods)
        return [PictureCell(name, _own_options(name), count, seed) for seed, count, name in product]
    grid = itertools.product(range(own.seeds), own.options, methods)
    return [PictureCell(name, options, COUNT, seed) for seed, options, name in grid]


def _own_options(method: str) -> int:
    return 0 if method.endswith("_flat") else OWN_OPTIONS[method.partition("_")[0]]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Which study, which part of it, and where it is kept."""
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--counts", type=int, nargs="+", default=[80, 40, 20, 10])
    parser.add_argument("--options", type=int, nargs="+", default=[1, 2, 3, 4, 5, 6])
    parser.add_argument("--summarize", action="store_true", help="do nothing that is not done")
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time; each works on one thread")
    parser.add_argument("--out", type=Path, default=Path("docs/results/pushing_pictures"))
    DEFAULTS.add_to(parser)


def main() -> None:
    """Run one study."""
    parser = described(__doc__)
    arguments(parser)
    printed(lambda: run(parser.parse_args()))


def run(own: argparse.Namespace) -> str:
    """Do what is not done yet, and write what there is; the page."""
    settings, asked = DEFAULTS.given(own), some(cells(own))
    before = Page.known(own, asked)
    made_by, until = record(asked[0].command(settings)), time.monotonic() + 60 * own.minutes
    if not own.summarize:
        todo = [cell for cell in asked if cell not in before.rows]
        Parallel(n_jobs=own.jobs, verbose=10)(delayed(_begun)(cell, settings, made_by, until) for cell in todo)
    return write(own, settings, asked, before)


@dataclass(frozen=True)
class Page:
    """What ``NAME.json`` has of cells with the settings that are asked for."""

    rows: dict[PictureCell, shown.Row]
    records: list[Record | None]

    @classmethod
    def known(cls, own: argparse.Namespace, asked: Sequence[PictureCell]) -> Page:
        """With the cells that are asked for and that other studies' pages beside it have."""
        page = cls.read(own, own.study)
        for other in (cls.read(own, name) for name in STUDIES):
            taken = {cell: other.rows[cell] for cell in asked if cell in other.rows.keys() - page.rows.keys()}
            commits = {row["commit"] for row in taken.values()}
            records = [one for one in other.records if one is not None and one["commit"] in commits]
            page = cls({**page.rows, **taken}, [*page.records, *records])
        return page

    @classmethod
    def read(cls, own: argparse.Namespace, name: str) -> Page:
        """That of a study. Nothing, where there is no file, or one of other settings."""
        path = own.out / f"{name}.json"
        content = json.loads(path.read_text()) if path.exists() else {"results": {}}
        if content["results"].get("settings") != DEFAULTS.given(own).kept():
            return cls({}, [])
        rows = {PictureCell(*(row[name] for name in FIELDS)): row for row in content["results"]["cells"]}
        return cls(rows, content["provenance"])


def _part(own: argparse.Namespace) -> str:
    """The words that say which part of a study is asked for."""
    across = {"count": "counts", "options": "options"}[shown.ACROSS[own.study]]
    methods = [name for name in STUDIES[own.study] if name in own.methods]
    return f"--{across} {' '.join(map(str, getattr(own, across)))} --methods {' '.join(methods)}"


def _begun(cell: PictureCell, settings: Settings, made_by: dict[str, str], until: float) -> None:
    if time.monotonic() < until:
        cell.run(settings, made_by)


def write(own: argparse.Namespace, settings: Settings, asked: Sequence[PictureCell], before: Page) -> str:
    """Write what there is of a study; the page."""
    paths = {cell: cell.path(settings) for cell in asked if cell not in before.rows}
    done = {cell: json.loads(path.read_text()) for cell, path in paths.items() if path.exists()}
    missing = [cell.name for cell in paths if cell not in done]
    new = [_row(cell, content, spec_of(cell, settings).control.std) for cell, content in done.items()]
    rows = shown.at_one_std([*before.rows.values(), *new])
    records = [*before.records, *(content["provenance"][0] for content in done.values())]
    command = f"python studies/pushing_pictures.py {own.study} --seeds {own.seeds} {_part(own)} {settings.words()}"
    page = shown.page(own.study, rows, missing, sentence(command, records))
    results = {"settings": settings.kept(), "cells": rows, "missing": missing}
    write_text(own.out / f"{own.study}.json", text(results, records))
    write_text(own.out / f"{own.study}.md", page)
    shown.draw(own.study, rows, own.out / f"{own.study}.png")
    return page


def _row(cell: PictureCell, content: dict[str, Any], std: Any) -> shown.Row:
    return shown.row_of(cell, content["results"]) | {"std": std, "commit": content["provenance"][0]["commit"]}


if __name__ == "__main__":
    main()
