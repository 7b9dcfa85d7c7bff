"""The tidy table of a study: a number in each row, under ``docs/results``."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from ddco_pyro.data.files import only_one, write_text

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


def read(path: Path) -> list[Row]:
    """The rows of a table; none where there is no table."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Row(one["study"], one["task"], one["method"], _whole(one["demonstrations"]), _whole(one["seed"]),
                one["measure"], float(one["value"]))
            for one in csv.DictReader(file)
        ]  # fmt: skip


def _whole(text: str) -> Any:
    return int(text) if text.isdigit() else text or None


def add(path: Path, rows: Iterable[Row]) -> None:
    """Write rows into a table, in the place of those of the same cell and measure; another process may do so too."""
    with only_one(path.parent, wait=True):
        known = {row[:-1]: row for row in read(path)}
        known |= {row[:-1]: row for row in rows}
        written = io.StringIO()
        table = csv.writer(written, lineterminator="\n")
        table.writerow(Row._fields)
        table.writerows((*row[:-1], f"{row.value:.9g}") for row in known.values())
        write_text(path, written.getvalue())


def shown(rows: Sequence[Row]) -> str:
    """Means over seeds with 95 % t intervals, as Markdown: a line for each method and number of demonstrations."""
    measures = list(dict.fromkeys(row.measure for row in rows))
    cells: dict[tuple[Any, ...], dict[str, list[float]]] = {}
    for row in rows:
        cells.setdefault(row[:4], {}).setdefault(row.measure, []).append(row.value)
    head = ["study", "task", "method", "demonstrations", *measures]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name, found in cells.items():
        numbers = [spread(over_seeds(found.get(measure, [])), "{:.3g}") for measure in measures]
        lines.append(f"| {' | '.join(['' if one is None else str(one) for one in name] + numbers)} |")
    return "\n".join(lines) + "\n"


def over_seeds(values: Sequence[float]) -> dict[str, Any]:
    """Mean over training seeds and its 95 % t ``interval``, which is None for a single seed."""
    found: dict[str, Any] = {"mean": float(np.mean(values)) if len(values) else None, "by_seed": list(values)}
    if len(values) < 2:
        return found | {"interval": None}
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return found | {"interval": [found["mean"] - half, found["mean"] + half]}


def spread(one: dict[str, Any], form: str) -> str:
    """A mean and its interval; a dash where there is none."""
    if one["mean"] is None:
        return "-"
    ends = f" [{', '.join(form.format(end) for end in one['interval'])}]" if one["interval"] else ""
    return form.format(one["mean"]) + ends
