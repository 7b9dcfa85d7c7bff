"""A comparison as Markdown and as a page of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from ddco_pyro.drawing import words
from ddco_pyro.drawing.templates import render
from ddco_pyro.fitting.analysis import paired
from ddco_pyro.fitting.convergence import effort
from ddco_pyro.report.demonstration_list import SHOWN
from ddco_pyro.segmenting.timeline import anchor

if TYPE_CHECKING:
    from ddco_pyro.comparison import Comparison, Row
    from ddco_pyro.drawing.pictures import Picture

HEAD = ("rank", "run", "model", "parameters", "total", "se", "diff", "dse", "nats/step", "gradient steps")
ROLLOUT_HEAD = ("run", "succeeds", "other", "succeeds", "only run", "only other", "states", "p")


def cells(row: Row) -> list[str]:
    """A run's row."""
    numbers = [words.number(value, 1) for value in (row.total, row.se, row.difference, row.dse)]
    if row.rank == 0:
        numbers[2:] = ["0", "0"]
    per_step = words.number(row.per_step, 3)
    return [str(row.rank), row.name, row.model, str(row.parameters), *numbers, per_step, effort(row.training)]


def rollout_cells(found: Comparison) -> list[list[str]]:
    """The rows of the paired rollouts."""
    return [
        [
            one["run"],
            words.rate(one["rate"]),
            one["other"],
            words.rate(one["other_rate"]),
            str(one["only_ours"]),
            str(one["only_theirs"]),
            str(one["trials"]),
            words.p_value(one["p_value"]),
        ]
        for one in found.rollouts
    ]


def verdict(found: Comparison) -> str:
    """Which run is the best, by how much, and whether that is more than its error: the report's first sentence."""
    best, *others = found.rows
    lengths = np.array(found.steps, dtype=float)
    differences = {row.name: paired(np.array(best.each), np.array(row.each), lengths) for row in others}
    rising = words.rising(row.name for row in found.rows if row.training and not row.training["converged"])
    return f"{words.explains(best.name, differences, len(found.trajectories))}{rising}"


def list_head(found: Comparison) -> list[str]:
    """The columns of the list of demonstrations."""
    return ["demonstration", "steps", *(row.name for row in found.rows)]


def list_cells(found: Comparison) -> list[list[str]]:
    """The rows of the list of demonstrations, nats per step, the least likely first."""
    return [
        [one["name"], str(one["steps"]), *(words.number(value) for value in one["log_likelihood_per_step"].values())]
        for one in found.worst_first
    ]


def list_note(found: Comparison) -> str:
    """What the list of demonstrations is."""
    return f"All of them were held out by every run. Nats per step, the least likely under {found.sorted_by} first."


def _links(found: Comparison, folder: Path) -> dict[str, str]:
    """Demonstrations to the address, from a page in ``folder``, of their segments in a run's report, if it has them."""
    report = Path(found.sorted_by) / "report.html"
    text = report.read_text(encoding="utf-8") if report.exists() else ""
    address = quote(Path(os.path.relpath(report, folder)).as_posix())
    places = {name: anchor(name) for name in found.trajectories}
    return {name: f"{address}#{place}" for name, place in places.items() if f'id="{place}"' in text}


def explanation(found: Comparison) -> str:
    """What the columns are."""
    more = " A run that had not converged may rank higher with more epochs."
    rising = any(row.training and not row.training["converged"] for row in found.rows)
    return (
        f"Held-out log-likelihood of {len(found.trajectories)} trajectories ({sum(found.steps)} steps), in nats. "
        "total: sum over trajectories; se: its standard error; diff: the best's total minus this one's, trajectory by "
        f"trajectory; dse: the standard error of that difference.{more if rising else ''}"
    )


def markdown(found: Comparison) -> str:
    """The verdict and tables in Markdown."""
    lines = [verdict(found), "", explanation(found), "", *_table(HEAD, [cells(row) for row in found.rows])]
    listed = list_cells(found)
    lines += ["", list_note(found), "", *_table(list_head(found), listed[:SHOWN])]
    if len(listed) > SHOWN:
        lines += ["", f"The other {len(listed) - SHOWN} are in `compare.json`."]
    if found.rollouts:
        lines += ["", "Success in rollouts from the same initial states; p: McNemar's exact test, two-sided.", ""]
        lines += _table(ROLLOUT_HEAD, rollout_cells(found))
    return "\n".join(lines) + "\n"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head), *(f"| {' | '.join(row)} |" for row in rows)]


def html(found: Comparison, picture: Picture, folder: Path) -> str:
    """A self-contained page for ``folder``; only its links to segments lead elsewhere, to a run's report."""
    listed = list_cells(found)
    values = {
        "verdict": verdict(found), "explanation": explanation(found), "head": HEAD,
        "rows": [cells(row) for row in found.rows], "list_head": list_head(found), "list_note": list_note(found),
        "first": listed[:SHOWN], "rest": listed[SHOWN:], "links": _links(found, folder),
        "rollout_head": ROLLOUT_HEAD, "rollouts": rollout_cells(found), "picture": picture,
    }  # fmt: skip
    return render("report/compare.html.j2", values)
