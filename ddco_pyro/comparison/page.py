"""A comparison as a page, in Markdown and as a figure."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from ddco_pyro.comparison import Comparison, Row
from ddco_pyro.data.files import json_text, write_text
from ddco_pyro.drawing import words
from ddco_pyro.drawing.figures import Interval, Panel, interval_plot, save
from ddco_pyro.drawing.page import Block, Cell, Drawing, Page, Section, Table, Text, note
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.agreement import EXPLAINED, UNMATCHED
from ddco_pyro.metrics import METRICS, Rate
from ddco_pyro.names import HIERARCHY, method
from ddco_pyro.report.likelihood import SHOWN
from ddco_pyro.segmenting.page import anchor
from ddco_pyro.statistics import worth

FILES = ("compare.svg", "compare.json", "compare.md", "compare.html")
"""The files of a comparison."""


def write(compared: Comparison, folder: Path) -> Path:
    """Write ``compare.json``, ``.md``, ``.html`` and ``.svg`` into a folder.

    :returns: the path of the page.
    """
    picture = write_figure(compared, folder / "compare.svg")
    whole = page(compared, picture, folder)
    write_text(folder / "compare.json", json_text(compared.as_data()))
    write_text(folder / "compare.md", whole.markdown())
    write_text(folder / "compare.html", whole.html())
    return folder / "compare.html"


def page(compared: Comparison, picture: Drawing, folder: Path) -> Page:
    """A page for ``folder``. Its only links are to segments in a run's report."""
    likelihood: list[Block] = [run_table(compared), note(_explanation(compared)), picture]
    sections = [Section("likelihood", "Held-out log-likelihood", likelihood)]
    if agreement := agreement_table(compared):
        sections.append(
            Section("agreement", "Agreement with labels", [agreement, note(f"Held-out trajectories. {EXPLAINED}")])
        )
    links = _links(compared, folder)
    listed = (
        "All of them were held out by every run. Nats per step, the least likely under "
        f"{compared.sorted_by} first.{' A name leads to the segments in the report of that run.' if links else ''}"
    )
    blocks = [note(listed), *demonstration_table(compared, links).folded(SHOWN, "demonstrations")]
    sections.append(Section("demonstrations", "Every held-out demonstration", blocks))
    if rollouts := rollout_table(compared):
        title = "Success in rollouts from the same initial states"
        sections.append(Section("rollouts", title, [rollouts, note(f"Rates: Wilson 95 % intervals. {words.P_VALUE}")]))
    return Page(f"Comparison of {len(compared.rows)} runs", [Text(verdict(compared), "verdict")], sections)


def run_table(compared: Comparison) -> Table:
    """A row for each run, the best first."""
    head = ["rank", "run", "model", "parameters", "total", "se", "diff", "dse", "nats/step", "gradient steps"]
    rows = []
    for row in compared.rows:
        numbers = [words.number(value, 1) for value in (row.total, row.se, row.difference, row.dse)]
        if row.rank == 0:
            numbers[2:] = ["0", "0"]
        first = [str(row.rank), row.name, method(row.model), str(row.parameters)]
        rows.append([*first, *numbers, words.number(row.per_step, 3), verdicts.effort(row.training)])
    return Table(head, rows, {0, 1, 2})


def agreement_table(compared: Comparison) -> Table | None:
    """A row for each level of each run with labels; None where there is none."""
    measures = (*UNMATCHED, "accuracy")
    rows = [
        [row["run"], row["level"], row["labels"], *(words.number(row[measure], 3) for measure in measures)]
        for row in compared.agreement
    ]
    head = ["run", "level", "labels", *(METRICS[measure].name for measure in measures)]
    return Table(head, rows, {0, 1, 2}, "agreement with labels, held out") if rows else None


def demonstration_table(compared: Comparison, links: dict[str, str] | None = None) -> Table:
    """Every demonstration, nats per step, the least likely first.

    :param links: names to addresses.
    """
    head, rows = ["demonstration", "steps", *(row.name for row in compared.rows)], []
    for row in compared.worst_first:
        values = [words.number(value) for value in row["log_likelihood_per_step"].values()]
        rows.append([Cell(row["name"], link=(links or {}).get(row["name"], "")), str(row["steps"]), *values])
    return Table(head, rows)


def rollout_table(compared: Comparison) -> Table | None:
    """A row for each pair of runs that were rolled out; None where there is none."""
    rows = []
    for pair in compared.rollouts:
        runs = [pair["run"], words.rate(Rate(**pair["rate"])), pair["other"], words.rate(Rate(**pair["other_rate"]))]
        counts = [str(pair["only_ours"]), str(pair["only_theirs"]), str(pair["trials"])]
        rows.append([*runs, *counts, words.p_value(pair["p_value"])])
    head = ["run", "succeeds", "other", "succeeds", "only run", "only other", "states", "p"]
    return Table(head, rows, {0, 1, 2, 3}) if rows else None


def verdict(compared: Comparison) -> str:
    """The best run, its lead and whether the lead is significant; what is doubtful about runs comes first."""
    best, *others = compared.rows
    steps = np.array(compared.steps, dtype=float)
    each = {row.name: np.array(row.each) for row in compared.rows}
    train, kinds = ({row.name: getattr(row, key) for row in compared.rows} for key in ("in_training", "model"))
    models = verdicts.Models(each, train, steps, kinds, compared.marginal)
    told = [" ".join(doubt) for name in each for doubt in models.doubts(name)]
    leads = {row.name: models.lead(best.name, row.name) for row in others}
    told.append(models.explains(best.name, leads))
    runs = [row.model for row in compared.rows]
    alone = {row.model: each[row.name] for row in compared.rows if runs.count(row.model) == 1}
    if models.sound() and (found := worth(HIERARCHY, alone, compared.steps)):
        told.append(models.lasting(found.memory))
        told += [] if compared.rollouts else [verdicts.said("success", "few")]
    rising = verdicts.rising(row.name for row in compared.rows if not row.training.converged)
    return f"{' '.join(told)}{rising}"


def _links(compared: Comparison, folder: Path) -> dict[str, str]:
    """Addresses of the demonstrations' segments in the report of the run that sorts them, relative to ``folder``."""
    report = Path(compared.sorted_by) / "report.html"
    text = report.read_text(encoding="utf-8") if report.exists() else ""
    address = quote(Path(os.path.relpath(report, folder)).as_posix())
    places = {name: anchor(name) for name in compared.trajectories}
    return {name: f"{address}#{place}" for name, place in places.items() if f'id="{place}"' in text}


def _explanation(compared: Comparison) -> str:
    more = " Not converged: more epochs may change the rank of such a run."
    rising = any(not row.training.converged for row in compared.rows)
    return (
        f"Held-out log-likelihood of {len(compared.trajectories)} trajectories ({sum(compared.steps)} steps), in nats: "
        f"{words.NAT}. total: sum over "
        "trajectories; se: its standard error. diff: the best's total minus this one's, trajectory by trajectory; dse: "
        "the standard error of that difference. Errors are over trajectories, for one fit of each run. The verdict has "
        f"the same numbers per step.{more if rising else ''}"
    )


def write_figure(compared: Comparison, path: Path) -> Drawing:
    """Draw the comparison as SVG."""
    alt = "; ".join(f"{row.name}: {row.total:.1f} nats held out" for row in compared.rows)
    caption = (
        f"Left: held-out log-likelihood of {len(compared.trajectories)} trajectories, ± one standard error. Right: "
        "each run's minus the best's, ± one standard error of the paired difference."
    )
    return save(draw(compared.rows, alt), path, caption)


def draw(rows: Sequence[Row], alt: str) -> Markup:
    """Totals and paired differences to the best, with their errors."""
    totals = [Interval.around(row.total, row.se) for row in rows]
    differences = [Interval.around(-row.difference, row.dse) if row.rank else None for row in rows]
    panels = [
        Panel("Each run", "held-out log-likelihood (nats)", totals, line=rows[0].total),
        Panel("Minus the best", "nats above the best, same trajectories", differences, line=0),
    ]
    return interval_plot([row.name for row in rows], panels, alt)
