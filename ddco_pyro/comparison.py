"""Runs compared on demonstrations that all of them held out, and on rollouts from the same initial states.

The table follows arviz's ``compare``: rank, total, standard error, difference to the best, its standard
error. The held-out log-likelihood of a trajectory takes the place of an observation's elpd.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from ddco_pyro.data.arrays import same
from ddco_pyro.data.controls import difference
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import json_text, write_text
from ddco_pyro.drawing import words
from ddco_pyro.drawing.figures import Interval, Panel, interval_plot, save
from ddco_pyro.drawing.page import Block, Cell, Drawing, Page, Section, Table, Text, note
from ddco_pyro.errors import BadInput, path_of
from ddco_pyro.evaluation import verdicts
from ddco_pyro.evaluation.agreement import EXPLAINED, UNMATCHED
from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.metrics import METRICS, Marginal, Rate, Training, read_successes
from ddco_pyro.names import HIERARCHY, method
from ddco_pyro.report.likelihood import SHOWN
from ddco_pyro.segmenting.page import anchor
from ddco_pyro.statistics import paired, paired_difference, rate, worth
from ddco_pyro.training.data import train_and_valid


@dataclass(frozen=True)
class Row:
    """One run, in nats over all held-out trajectories.

    Errors are :func:`ddco_pyro.statistics.paired` times the steps: the variation over held-out demonstrations
    for one fit of each run.

    :param total: Σ log p(ξ_n), and its standard error ``se``; None for a single trajectory.
    :param difference: the best run's total minus this one's, and its standard error ``dse``. The trajectories
        are the same, so ``dse`` is smaller than the two ``se`` suggest.
    :param per_step: Σ log p(ξ_n) per step, and the same ``in_training``.
    :param each: log p(ξ_n) of every trajectory.
    """

    rank: int
    name: str
    model: str
    parameters: int
    total: float
    se: float | None
    difference: float
    dse: float | None
    per_step: float
    in_training: float
    each: tuple[float, ...]
    training: Training


@dataclass(frozen=True)
class Comparison:
    """A comparison of runs.

    :param rows: the runs, the best first.
    :param trajectories: the held-out trajectories, and the ``steps`` of each.
    :param agreement: agreement of options with labels, a dict for each level of each run.
    :param rollouts: success paired by initial state, a dict for each pair of runs.
    :param sorted_by: the run whose likelihood sorts the trajectories: the best with options, or the best.
    :param marginal: the density without observations that the best run knows; baselines know none.
    """

    rows: Sequence[Row]
    trajectories: Sequence[str]
    steps: Sequence[int]
    agreement: Sequence[dict[str, Any]]
    rollouts: Sequence[dict[str, Any]]
    sorted_by: str
    marginal: Marginal | None = None

    @property
    def worst_first(self) -> list[dict[str, Any]]:
        """Every trajectory with its log-likelihood per step under each run, the least likely first."""
        listed = [
            {
                "name": name,
                "steps": steps,
                "log_likelihood_per_step": {row.name: row.each[place] / steps for row in self.rows},
            }
            for place, (name, steps) in enumerate(zip(self.trajectories, self.steps, strict=True))
        ]
        return sorted(listed, key=lambda one: one["log_likelihood_per_step"][self.sorted_by])

    def as_data(self) -> dict[str, Any]:
        """The comparison as plain data for ``compare.json``."""
        return {
            "trajectories": list(self.trajectories),
            "steps": sum(self.steps),
            "demonstrations": self.worst_first,
            "rows": [asdict(row) | {"training": row.training.model_dump()} for row in self.rows],
            "agreement": list(self.agreement),
            "rollouts": list(self.rollouts),
        }


def compare(runs: Sequence[str | Path], allow_code: bool = False) -> Comparison:
    """Compare runs; a run's ``baselines/NAME`` is a run, too.

    >>> compared = ddco_pyro.compare(["runs/mine", "runs/mine/baselines/flat"])
    >>> len(compared.rows), compared.rows[0].difference  # nats per step below the best
    (2, 0.0)

    :param allow_code: import the user code that the specs name.
    :raises BadInput: there are fewer than two runs, one is named twice or unfinished, held-out data differ.
    """
    folders = [path_of(run, "runs") for run in runs]
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise BadInput("the same run is given twice; name each once")
    if len(folders) < 2:
        more = "name at least two, such as RUN and RUN/baselines/flat"
        raise BadInput(f"one run alone cannot be compared; {more}")
    fits = [load(folder, allow_code) for folder in folders]
    demos = _shared(fits)
    values = [_log_likelihoods(fit, own) for fit, own in zip(fits, demos, strict=True)]
    best = max(values, key=np.sum)
    order = sorted(range(len(fits)), key=lambda run: -float(values[run].sum()))
    rows = [_row(rank, fits[run], values[run], best, demos[0].lengths) for rank, run in enumerate(order)]
    ranked = [fits[run] for run in order]
    every = (row for fit in ranked for row in _agreement(fit))
    # several runs have the same parts
    agreement = {(row["run"], row["level"], row["labels"]): row for row in every}
    sorted_by = next((fit.place for fit in ranked if fit.spec.hierarchy), ranked[0].place)
    marginal = next((fit.metrics.marginal for fit in ranked if fit.metrics.marginal), None)
    names, lengths, pairs = demos[0].names, demos[0].lengths, _paired_rollouts(ranked)
    return Comparison(rows, names, lengths, [*agreement.values()], pairs, sorted_by, marginal)


def _row(rank: int, fit: Fit, values: np.ndarray, best: np.ndarray, lengths: Sequence[int]) -> Row:
    steps = np.array(lengths, dtype=float)
    own = paired(values, np.zeros(len(steps)), steps)
    se, dse = (pair.standard_error for pair in (own, paired(best, values, steps)))
    return Row(
        rank,
        fit.place,
        fit.name,
        fit.metrics.parameters,
        total=float(values.sum()),
        se=se and se * sum(lengths),
        difference=float((best - values).sum()),
        dse=dse and dse * sum(lengths),
        per_step=own.nats_per_step,
        in_training=fit.metrics.log_likelihood_per_step.train,
        each=tuple(values.tolist()),
        training=fit.metrics.training,
    )


def _shared(fits: Sequence[Fit]) -> list[Demonstrations]:
    """The held-out demonstrations of each run, which are the same ones in the same order.

    :raises BadInput: they differ, or the runs score other dimensions of the control.
    """
    own = [train_and_valid(fit.spec, fit.demonstrations).get("valid") for fit in fits]
    shared: list[Demonstrations] = []
    for fit, demos in zip(fits, own, strict=True):
        if demos is None:
            held = "held nothing out (demonstrations.valid_fraction: 0)"
            raise BadInput(f"{fit.place}: {held}; there is nothing to compare")
        if shared:
            _check_same(fits[0], shared[0], fit, demos)
            _check_measure(fits[0], fit)
        shared.append(demos.select(shared[0].names) if shared else demos)
    return shared


def _check_same(first: Fit, ours: Demonstrations, second: Fit, theirs: Demonstrations) -> None:
    """Held-out demonstrations have the same names, controls, and observations where both runs see them."""
    lead = f"{first.place} and {second.place} were not held out on the same data"
    only = sorted(set(ours.names) ^ set(theirs.names))
    if only:
        where = (first if only[0] in ours.names else second).place
        remedy = "fit both with the same demonstrations, valid_fraction and seed"
        raise BadInput(f"{lead}: {only[0]} was held out by {where} alone; {remedy}")
    for mine, yours in zip(ours, theirs.select(ours.names), strict=True):
        both = [key for key in mine.observations if key in yours.observations]
        arrays = {f"obs/{key}": (mine.observations[key], yours.observations[key]) for key in both}
        arrays["actions"] = (mine.actions, yours.actions)
        if different := ", ".join(key for key, (left, right) in arrays.items() if not same(left, right)):
            raise BadInput(f"{lead}: {mine.name} has other {different}; fit both to the same demonstrations")


def _check_measure(first: Fit, second: Fit) -> None:
    """Both likelihoods are of the same control dimensions (constant ones are in no model), in one measure."""
    ours, theirs = (set(fit.hierarchy.scaling.varying.tolist()) for fit in (first, second))
    if ours != theirs:
        dimension = min(ours ^ theirs)
        scored, left = (first, second) if dimension in ours else (second, first)
        raise BadInput(
            f"{first.place} and {second.place} score different things: control dimension {dimension} is in "
            f"the likelihood of {scored.place} and not in that of {left.place}; fit both to the same "
            "demonstrations, with the same version"
        )
    if different := difference(first.hierarchy.scaling.parts, second.hierarchy.scaling.parts):
        raise BadInput(
            f"{first.folder} and {second.folder} measure different things: {different}; densities and "
            "probabilities cannot be ranked, so fit both with the same control.kind"
        )


def _log_likelihoods(fit: Fit, demos: Demonstrations) -> np.ndarray:
    """log p(ξ) of each demonstration.

    :raises BadInput: a value is not the one in ``metrics.json``.
    """
    values = np.concatenate([piece.log_likelihood for piece in fit.infer(demos, held_out=True)])
    for name, value in zip(demos.names, values, strict=True):
        if not fit.was_held_out(name, float(value)):
            raise BadInput(f"{fit.place}: {name} has changed since this run was fitted to it; fit it again")
    return values


def _agreement(fit: Fit) -> Iterator[dict[str, Any]]:
    """For each level: the measures that need no matching, and ``accuracy`` with options matched globally.

    The same is given for equal parts of each demonstration, as many as options.
    A measure is None where no label is known.
    """
    record = fit.metrics.agreement
    if not record or not record.valid or fit.spec.hierarchy is None:
        return
    equal = record.equal_valid or [None] * len(record.valid)
    levels = zip(fit.spec.hierarchy.levels, record.labels, record.valid, equal, strict=True)
    for level, labels, *each in levels:
        for run, scores in zip((fit.place, f"equal lengths, {level.count} parts"), each, strict=True):
            found = {key: scores and getattr(scores, key) for key in UNMATCHED}
            accuracy = scores and scores.matched_globally.accuracy
            yield {"run": run, "level": level.name, "labels": labels, **found, "accuracy": accuracy}


def _paired_rollouts(fits: Sequence[Fit]) -> list[dict[str, Any]]:
    """Success of each run against the first one rolled out in the task, on the initial states of both.

    ``p_value`` is McNemar's exact one.
    """
    known = [(fit, outcomes) for fit in fits if (outcomes := _outcomes(fit))]
    pairs = []
    for fit, theirs in known[1:]:
        first, ours = known[0]
        seeds = sorted(ours.keys() & theirs.keys())
        if fit.spec.task == first.spec.task and seeds:
            left, right = [ours[seed] for seed in seeds], [theirs[seed] for seed in seeds]
            rates = {"rate": rate(int(sum(left)), len(left)), "other_rate": rate(int(sum(right)), len(right))}
            each = {name: one.model_dump() for name, one in rates.items()}
            counts = dict(paired_difference(left, right))
            pairs.append({"run": first.place, "other": fit.place, **counts, **each})
    return pairs


def _outcomes(fit: Fit) -> dict[int, float]:
    """Success (1) or not (0) by the seed of the initial state; a baseline's are in its run's folder, too."""
    folder = fit.run_folder.resolve()
    run = folder.parent.parent
    tables = [(folder, fit.name), *([(run, folder.name)] if folder.parent == run / "baselines" else [])]
    for place, name in tables:
        own = {seed: value for (method, seed), value in read_successes(place).items() if method == name}
        if own:
            return own
    return {}


# --- the page -----------------------------------------------------------------------------------------------


def write(compared: Comparison, folder: Path) -> Path:
    """Write ``compare.json``, ``.md``, ``.html`` and ``.svg`` into a folder.

    :returns: the path of the page.
    """
    picture = drawn(compared, folder / "compare.svg")
    whole = page(compared, picture, folder)
    write_text(folder / "compare.json", json_text(compared.as_data()))
    write_text(folder / "compare.md", whole.markdown())
    write_text(folder / "compare.html", whole.html())
    return folder / "compare.html"


def page(compared: Comparison, picture: Drawing, folder: Path) -> Page:
    """A page for ``folder``. Its only links are to segments in a run's report."""
    explained = (
        f"Held-out log-likelihood of {len(compared.trajectories)} trajectories ({sum(compared.steps)} "
        f"steps), in nats: {words.NAT}. total: sum over trajectories; se: its standard error. diff: the "
        "best's total minus this one's, trajectory by trajectory; dse: the standard error of that "
        "difference. Errors are over trajectories, for one fit of each run. The verdict has the same numbers "
        "per step."
    )
    if not all(row.training.converged for row in compared.rows):
        explained += " Not converged: more epochs may change the rank of such a run."
    likelihood: list[Block] = [run_table(compared), note(explained), picture]
    sections = [Section("likelihood", "Held-out log-likelihood", likelihood)]
    if agreement := agreement_table(compared):
        held_out = note(f"Held-out trajectories. {EXPLAINED}")
        sections.append(Section("agreement", "Agreement with labels", [agreement, held_out]))
    links = _links(compared, folder)
    listed = (
        f"All of them were held out by every run. Nats per step, the least likely under {compared.sorted_by} "
        f"first.{' A name leads to the segments in the report of that run.' if links else ''}"
    )
    blocks = [note(listed), *demonstration_table(compared, links).folded(SHOWN, "demonstrations")]
    sections.append(Section("demonstrations", "Every held-out demonstration", blocks))
    if rollouts := rollout_table(compared):
        title = "Success in rollouts from the same initial states"
        rates = note(f"Rates: Wilson 95 % intervals. {words.P_VALUE}")
        sections.append(Section("rollouts", title, [rollouts, rates]))
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
        ours, theirs = (words.rate(Rate(**pair[key])) for key in ("rate", "other_rate"))
        runs = [pair["run"], ours, pair["other"], theirs]
        counts = [str(pair["only_ours"]), str(pair["only_theirs"]), str(pair["trials"])]
        rows.append([*runs, *counts, words.p_value(pair["p_value"])])
    head = ["run", "succeeds", "other", "succeeds", "only run", "only other", "states", "p"]
    return Table(head, rows, {0, 1, 2, 3}) if rows else None


def verdict(compared: Comparison) -> str:
    """The best run, its lead and whether the lead is significant; what is doubtful about runs comes first."""
    best, *others = compared.rows
    steps = np.array(compared.steps, dtype=float)
    each = {row.name: np.array(row.each) for row in compared.rows}
    train = {row.name: row.in_training for row in compared.rows}
    kinds = {row.name: row.model for row in compared.rows}
    models = verdicts.Models(each, train, steps, kinds, compared.marginal)
    told = [" ".join(doubt) for name in each for doubt in models.doubts(name)]
    leads = {row.name: models.lead(best.name, row.name) for row in others}
    told.append(models.explains(best.name, leads))
    runs = [row.model for row in compared.rows]
    alone = {row.model: each[row.name] for row in compared.rows if runs.count(row.model) == 1}
    if models.sound() and (found := worth(HIERARCHY, alone, partial(paired, lengths=steps))):
        told.append(models.lasting(found.memory))
        told += [] if compared.rollouts else [verdicts.said("success", "few")]
    rising = verdicts.rising(row.name for row in compared.rows if not row.training.converged)
    return f"{' '.join(told)}{rising}"


def _links(compared: Comparison, folder: Path) -> dict[str, str]:
    """Addresses of demonstrations' segments in the report of the run that sorts, relative to ``folder``."""
    report = Path(compared.sorted_by) / "report.html"
    text = report.read_text(encoding="utf-8") if report.exists() else ""
    address = quote(Path(os.path.relpath(report, folder)).as_posix())
    places = {name: anchor(name) for name in compared.trajectories}
    return {name: f"{address}#{place}" for name, place in places.items() if f'id="{place}"' in text}


def drawn(compared: Comparison, path: Path) -> Drawing:
    """Totals and paired differences to the best with errors: a figure of the page and a file of its own."""
    rows = compared.rows
    totals = [Interval.around(row.total, row.se) for row in rows]
    differences = [Interval.around(-row.difference, row.dse) if row.rank else None for row in rows]
    panels = [
        Panel("Each run", "held-out log-likelihood (nats)", totals, line=rows[0].total),
        Panel("Minus the best", "nats above the best, same trajectories", differences, line=0),
    ]
    alt = "; ".join(f"{row.name}: {row.total:.1f} nats held out" for row in rows)
    caption = (
        f"Left: held-out log-likelihood of {len(compared.trajectories)} trajectories, ± one standard error. "
        "Right: each run's minus the best's, ± one standard error of the paired difference."
    )
    return save(interval_plot([row.name for row in rows], panels, alt), path, caption)
