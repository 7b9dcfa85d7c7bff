"""The page's tables as rows of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.words import interval, measure, method, number, p_value, percent, rate, signed
from ddco_pyro.fitting.convergence import effort
from ddco_pyro.report.plot_likelihood import Likelihood
from ddco_pyro.report.strips import choice_name


@dataclass(frozen=True)
class Table:
    """A table: ``head`` and ``rows``, the first column on the left, numbers on the right; ``colours`` of the rows."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    colours: Sequence[str] = ()


def measures(methods: Mapping[str, Mapping[str, Any]]) -> Table:
    """Every measure of every method, as in the paper's table."""
    names = list(dict.fromkeys(name for one in methods.values() for name in one["measures"]))
    rows = [[method(key), *(_cell(one["measures"].get(name)) for name in names)] for key, one in methods.items()]
    return Table(["Method", *map(measure, names)], rows)


def _cell(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "–"
    if "mean" not in found:
        return rate(found)
    if not found["trials"]:
        return "– (n = 0)"
    spread = "" if found["std"] is None else f" ± {number(found['std'])} [{interval(found['interval'])}]"
    return f"{number(found['mean'])}{spread}, n = {found['trials']}"


def against(methods: Mapping[str, Mapping[str, Any]], ours: str) -> Table | None:
    """The paired comparison of success on the same initial states; None where there is none."""
    rows = [
        [method(name), str(one["only_ours"]), str(one["only_theirs"]), str(one["trials"]), p_value(one["p_value"])]
        for name, one in ((name, found["against"]) for name, found in methods.items() if "against" in found)
    ]
    head = [f"{method(ours)} against", f"Only {method(ours)} succeeds", "Only the other succeeds", "Episodes", "p"]
    return Table(head, rows) if rows else None


def option_use(levels: Sequence[str], options: Sequence[Sequence[Mapping[str, Any]]], demonstrations: int) -> Table:
    """How each choice of each level is used, the highest level first; control only where it is chosen."""
    rows, colours = [], []
    for level, use in reversed(list(zip(levels, options, strict=True))):
        for one in use:
            if one["choice"] or one["share"] > 0:
                each = one["selected"] / demonstrations
                last = [percent(one["share"], 1), number(one["selected"], 1), number(each), number(one["duration"], 1)]
                rows.append([level, choice_name(one["choice"]), *last])
                colours.append(option_colour(one["choice"]))
    head = ["Level", "Choice", "Share of steps", "Selections", "Selections per demonstration", "Expected steps"]
    return Table(head, rows, colours)


def likelihood(found: Sequence[Likelihood]) -> Table:
    """Log-likelihood per step of each method, the differences with their standard errors, and what they took."""
    rows = []
    for one in found:
        difference = "" if one.difference is None else f"{signed(one.difference[0])} ± {number(one.difference[1])}"
        size = "–" if one.parameters is None else str(one.parameters)
        likelihoods = [number(one.valid), number(one.train), difference]
        rows.append([method(one.name), *likelihoods, size, effort(one.training)])
    ours = f"{method(found[0].name)} minus it, held out"
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
