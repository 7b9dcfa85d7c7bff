"""A comparison as Markdown and as a page of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import jinja2

from ddco_pyro.convergence import effort
from ddco_pyro.report import words

if TYPE_CHECKING:
    from ddco_pyro.comparison import Comparison, Row
    from ddco_pyro.report.pictures import Picture

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


def explanation(found: Comparison) -> str:
    """What the columns are."""
    more = " A run that had not converged may rank higher with more epochs."
    rising = any(row.training and not row.training["converged"] for row in found.rows)
    return (
        f"Held-out log-likelihood of {len(found.trajectories)} trajectories ({found.steps} steps), in nats. total: sum "
        "over trajectories; se: its standard error; diff: the best's total minus this one's, trajectory by trajectory; "
        f"dse: the standard error of that difference.{more if rising else ''}"
    )


def markdown(found: Comparison) -> str:
    """Tables in Markdown."""
    lines = [explanation(found), "", *_table(HEAD, [cells(row) for row in found.rows])]
    if found.rollouts:
        lines += ["", "Success in rollouts from the same initial states; p: McNemar's exact test, two-sided.", ""]
        lines += _table(ROLLOUT_HEAD, rollout_cells(found))
    return "\n".join(lines) + "\n"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head), *(f"| {' | '.join(row)} |" for row in rows)]


def html(found: Comparison, picture: Picture) -> str:
    """A self-contained page."""
    loader = jinja2.PackageLoader("ddco_pyro.report", ".")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.get_template("compare.html.j2").render(
        explanation=explanation(found), head=HEAD, rows=[cells(row) for row in found.rows],
        rollout_head=ROLLOUT_HEAD, rollouts=rollout_cells(found), picture=picture,
    )  # fmt: skip
