"""The page's tables as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ddco_pyro.drawing import scores
from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.words import interval, measure, method, number, option_name, p_value, percent, rate, signed
from ddco_pyro.report.plot_likelihood import Likelihood
from ddco_pyro.training.convergence import effort


@dataclass(frozen=True)
class Table:
    """A table: ``head`` and ``rows``, the first column on the left, numbers on the right; ``colours`` of the rows."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    colours: Sequence[str] = ()


def measures(methods: Mapping[str, Mapping[str, Any]]) -> Table:
    """Every measure of every method, as in the paper's table."""
    names = list(dict.fromkeys(name for entry in methods.values() for name in entry["measures"]))
    rows = [[method(key), *(_cell(entry["measures"].get(name)) for name in names)] for key, entry in methods.items()]
    return Table(["Method", *map(measure, names)], rows)


def _cell(summary: Mapping[str, Any] | None) -> str:
    if summary is None:
        return "–"
    if "mean" not in summary:
        return rate(summary)
    if not summary["trials"]:
        return "– (n = 0)"
    spread = "" if summary["std"] is None else f" ± {number(summary['std'])} [{interval(summary['interval'])}]"
    return f"{number(summary['mean'])}{spread}, n = {summary['trials']}"


def against(methods: Mapping[str, Mapping[str, Any]], ours: str) -> Table | None:
    """The paired comparison of success on the same initial states; None where there is none."""
    rows = [
        [method(name), str(pair["only_ours"]), str(pair["only_theirs"]), str(pair["trials"]), p_value(pair["p_value"])]
        for name, pair in ((name, results["against"]) for name, results in methods.items() if "against" in results)
    ]
    head = [f"{method(ours)} against", f"Only {method(ours)} succeeds", "Only the other succeeds", "Episodes", "p"]
    return Table(head, rows) if rows else None


def option_use(
    levels: Sequence[str],
    options: Sequence[Sequence[Mapping[str, Any]]],
    demonstrations: int,
    labels: Mapping[str, Mapping[int, int]] | None = None,
) -> Table:
    """How each choice of each level is used, the highest level first; control only where it is chosen.

    :param labels: the label that each option stands for, by level, where there is one.
    """
    labels = labels or {}
    rows, colours = [], []
    for level, use in reversed(list(zip(levels, options, strict=True))):
        for row in use:
            if row["choice"] or row["share"] > 0:
                each = row["selected"] / demonstrations
                last = [percent(row["share"], 1), number(row["selected"], 1), number(each), number(row["duration"], 1)]
                rows.append([level, option_name(row["choice"], labels.get(level)), *last])
                colours.append(option_colour(row["choice"]))
    head = ["Level", "Choice", "Share of steps", "Selections", "Selections per demonstration", "Expected steps"]
    return Table(head, rows, colours)


def likelihood(compared: Sequence[Likelihood]) -> Table:
    """Log-likelihood per step of each method, the differences with their standard errors, and what they took."""
    rows = []
    for row in compared:
        difference = "" if row.difference is None else f"{signed(row.difference[0])} ± {number(row.difference[1])}"
        size = "–" if row.parameters is None else str(row.parameters)
        likelihoods = [number(row.valid), number(row.train), difference]
        rows.append([method(row.name), *likelihoods, size, effort(row.training)])
    ours = f"{method(compared[0].name)} minus it, held out"
    return Table(["Method", "Held out", "Training", ours, "Parameters", "Gradient steps"], rows)


def branches(uses: Sequence[Mapping[str, Any]], names: Sequence[Sequence[str]]) -> Table:
    """Activation of each branch and what is lost without its input, a row for each option and branch."""
    rows = [
        [option, branch, number(use["activation"][row][column], 3), number(use["loss"][row][column], 3)]
        for use, options in zip(uses, names, strict=True)
        for row, option in enumerate(options)
        for column, branch in enumerate(use["branches"])
    ]
    return Table(["Option", "Branch", "Mean activation", "Nats per step lost"], rows)


def agreement(levels: Sequence[str], record: Mapping[str, Any]) -> Table:
    """All measures of each level's agreement with labels, held out and in training."""
    parts = {"valid": "held out", "train": "training"}
    rows = [
        row
        for place, level in enumerate(levels)
        for part, words in parts.items()
        if part in record
        for row in scores.rows(f"{level}, {words}" if len(levels) > 1 else words, record[part][place])
    ]
    return Table(scores.HEAD, rows)


def confusion(record: Mapping[str, Any]) -> Table:
    """Share of each label's steps in each option; under the options, the label that each stands for."""
    head = ["Label", "Steps", *map(option_name, record["options"])]
    rows = [
        [str(label), str(sum(steps)), *(percent(count / sum(steps)) if count else "" for count in steps)]
        for label, steps in zip(record["labels"], record["steps"], strict=True)
    ]
    matched = ["–" if label is None else str(label) for label in record["matched"]]
    return Table(head, [*rows, ["stands for", "", *matched]])
