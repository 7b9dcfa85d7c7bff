"""A comparison as Markdown and as a page of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ddco_pyro.comparison.table import Comparison, Row
from ddco_pyro.drawing import words
from ddco_pyro.drawing.pictures import Picture
from ddco_pyro.drawing.templates import render
from ddco_pyro.evaluation.worth import worth
from ddco_pyro.fitting.fit import HIERARCHY
from ddco_pyro.report.demonstration_list import SHOWN
from ddco_pyro.segmenting.timeline import anchor
from ddco_pyro.training.convergence import effort

HEAD = ("rank", "run", "model", "parameters", "total", "se", "diff", "dse", "nats/step", "gradient steps")
AGREEMENT_HEAD = ("run", "level", "labels", "NMI", "MoF", "boundary F1 ±1", "±3", "±5")
ROLLOUT_HEAD = ("run", "succeeds", "other", "succeeds", "only run", "only other", "states", "p")

AGREEMENT = (
    "Agreement of options with labels on the same trajectories, 1 where it is perfect; no run is ranked by it. NMI: "
    "normalised mutual information; MoF: mean over frames, steps that agree where each option stands for one label; "
    "boundary F1: where segments begin, within so many steps."
)


def cells(row: Row) -> list[str]:
    """A run's row."""
    numbers = [words.number(value, 1) for value in (row.total, row.se, row.difference, row.dse)]
    if row.rank == 0:
        numbers[2:] = ["0", "0"]
    per_step = words.number(row.per_step, 3)
    return [str(row.rank), row.name, row.model, str(row.parameters), *numbers, per_step, effort(row.training)]


def agreement_cells(compared: Comparison) -> list[list[str]]:
    """The rows of the agreement with labels."""
    measures = ("nmi", "accuracy", "boundary_f1_1", "boundary_f1_3", "boundary_f1_5")
    return [
        [row["run"], row["level"], row["labels"], *(words.number(row[measure], 3) for measure in measures)]
        for row in compared.agreement
    ]


def rollout_cells(compared: Comparison) -> list[list[str]]:
    """The rows of the paired rollouts."""
    return [
        [
            pair["run"],
            words.rate(pair["rate"]),
            pair["other"],
            words.rate(pair["other_rate"]),
            str(pair["only_ours"]),
            str(pair["only_theirs"]),
            str(pair["trials"]),
            words.p_value(pair["p_value"]),
        ]
        for pair in compared.rollouts
    ]


def verdict(compared: Comparison) -> str:
    """Which run is the best, by how much, and whether that is more than its error: the report's first sentence."""
    best, *others = compared.rows
    steps = sum(compared.steps)
    differences = {
        row.name: {"nats_per_step": row.difference / steps, "standard_error": row.dse / steps} for row in others
    }
    rising = words.rising(row.name for row in compared.rows if row.training and not row.training["converged"])
    parts = _worth(compared)
    return f"{words.explains(best.name, differences, len(compared.trajectories))}{' ' * bool(parts)}{parts}{rising}"


def _worth(compared: Comparison) -> str:
    """What several experts and options that last are worth, where one run of each model says so."""
    models = [row.model for row in compared.rows]
    alone = {row.model: np.array(row.each) for row in compared.rows if models.count(row.model) == 1}
    found = worth(HIERARCHY, alone, compared.steps) if HIERARCHY in alone else {}
    return words.worth(found, words.method(HIERARCHY), len(compared.trajectories)) if found else ""


def list_head(compared: Comparison) -> list[str]:
    """The columns of the list of demonstrations."""
    return ["demonstration", "steps", *(row.name for row in compared.rows)]


def list_cells(compared: Comparison) -> list[list[str]]:
    """The rows of the list of demonstrations, nats per step, the least likely first."""
    return [
        [row["name"], str(row["steps"]), *(words.number(value) for value in row["log_likelihood_per_step"].values())]
        for row in compared.worst_first
    ]


def list_note(compared: Comparison) -> str:
    """What the list of demonstrations is."""
    return f"All of them were held out by every run. Nats per step, the least likely under {compared.sorted_by} first."


def _links(compared: Comparison, folder: Path) -> dict[str, str]:
    """Demonstrations to the address, from a page in ``folder``, of their segments in a run's report, if it has them."""
    report = Path(compared.sorted_by) / "report.html"
    text = report.read_text(encoding="utf-8") if report.exists() else ""
    address = quote(Path(os.path.relpath(report, folder)).as_posix())
    places = {name: anchor(name) for name in compared.trajectories}
    return {name: f"{address}#{place}" for name, place in places.items() if f'id="{place}"' in text}


def explanation(compared: Comparison) -> str:
    """What the columns are."""
    more = " A run that had not converged may rank higher with more epochs."
    rising = any(row.training and not row.training["converged"] for row in compared.rows)
    return (
        f"Held-out log-likelihood of {len(compared.trajectories)} trajectories ({sum(compared.steps)} steps), in nats. "
        "total: sum over trajectories; se: its standard error; diff: the best's total minus this one's, trajectory by "
        f"trajectory; dse: the standard error of that difference. Errors are over trajectories, for one fit of each "
        f"run; the verdict has the same per step.{more if rising else ''}"
    )


def markdown(compared: Comparison) -> str:
    """The verdict and tables in Markdown."""
    lines = [verdict(compared), "", explanation(compared), "", *_table(HEAD, [cells(row) for row in compared.rows])]
    if compared.agreement:
        lines += ["", AGREEMENT, "", *_table(AGREEMENT_HEAD, agreement_cells(compared))]
    listed = list_cells(compared)
    lines += ["", list_note(compared), "", *_table(list_head(compared), listed[:SHOWN])]
    if len(listed) > SHOWN:
        lines += ["", f"The other {len(listed) - SHOWN} are in `compare.json`."]
    if compared.rollouts:
        lines += ["", "Success in rollouts from the same initial states; p: McNemar's exact test, two-sided.", ""]
        lines += _table(ROLLOUT_HEAD, rollout_cells(compared))
    return "\n".join(lines) + "\n"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(head)} |", "|" + "---|" * len(head), *(f"| {' | '.join(row)} |" for row in rows)]


def html(compared: Comparison, picture: Picture, folder: Path) -> str:
    """A self-contained page for ``folder``; only its links to segments lead elsewhere, to a run's report."""
    listed = list_cells(compared)
    values = {
        "verdict": verdict(compared), "explanation": explanation(compared), "head": HEAD,
        "rows": [cells(row) for row in compared.rows], "list_head": list_head(compared),
        "agreement_head": AGREEMENT_HEAD, "agreement": agreement_cells(compared), "agreement_note": AGREEMENT,
        "list_note": list_note(compared), "first": listed[:SHOWN], "rest": listed[SHOWN:], "picture": picture,
        "rollout_head": ROLLOUT_HEAD, "rollouts": rollout_cells(compared), "links": _links(compared, folder),
    }  # fmt: skip
    return render("report/compare.html.j2", values)
