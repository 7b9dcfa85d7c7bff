"""What the cells of pushing from pictures say together: means over training seeds, their intervals, and a figure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pushing_results import grouped, over_seeds, table

from ddco_pyro.data.files import whole_file

Row = dict[str, Any]

STATE = "docs/results/pushing/sample_complexity.md"
COLUMNS = {
    "goals": ("goals", "{:.1f}"),
    "goals, 250 steps each at most": ("limited", "{:.1f}"),
    "topples": ("topples", "{:.1f}"),
    "lost": ("lost", "{:.1f}"),
    "held-out nats/step": ("held_out", "{:.3f}"),
    "held out, at one σ": ("at_one_std", "{:.3f}"),
    "training nats/step": ("train", "{:.3f}"),
    "steps an option lasts": ("dwell", "{:.0f}"),
    "steps under own control": ("own_control", "{:.2f}"),
    "parameters": ("parameters", "{:.0f}"),
    "minutes": ("minutes", "{:.1f}"),
    "of them processor, fit": ("processor", "{:.1f}"),
}
ACROSS = {
    **dict.fromkeys(("demonstrations", "encoded", "large"), "count"),
    **dict.fromkeys(("options", "augmentation"), "options"),
}
"""What each study varies."""

WORDS = {"count": "{method} minus {other}, {place} demonstrations", "options": "{method}, k = {place}, minus {other}"}
"""What is compared, by what is varied."""

CONTROLS = 3
"""Joints of the arm."""

OTHERS = {
    "encoded": {"ff_flat": "the flat policy whose features it reads"},
    "ff_large": {"ff": "the same of small pictures"},
    "ff_large_flat": {"ff_flat": "the same of small pictures"},
    "ff_two": {"ff": "the same of one picture"},
    "ff_two_flat": {"ff_flat": "the same of one picture"},
}
"""What a method is compared with besides the flat policy of equal size."""

FEWEST = 3
"""Training seeds of whose mean the figure has an interval; every seed is a dot."""


def row_of(cell: Any, results: dict[str, Any]) -> Row:
    """A cell in a line: means over its episodes."""
    seconds, episodes = results["seconds"], results["unlimited"]
    return {
        **asdict(cell),
        **results["log_likelihood_per_step"],
        **{name: float(np.mean(episodes[name])) for name in ("goals", "topples", "lost")},
        "limited": float(np.mean(results["limited"]["goals"])),
        "episodes": len(episodes["goals"]),
        "dwell": episodes["dwell"],
        "own_control": episodes["own_control"],
        "parameters": results["parameters"],
        "minutes": (seconds["fit"] + seconds["play"]) / 60,
        "processor": seconds["fit_processor"] / 60,
        "device": results["steps"]["device"],
    }


def at_one_std(rows: Sequence[Row]) -> list[Row]:
    """The same rows with ``at_one_std``, their held-out likelihood at the smallest σ of all: methods with others can be
    compared by it. That of a flat policy at another σ follows from its own; that of options does not, and is None. A σ
    that is learnt stays.
    """
    smallest = min((row["std"] for row in rows if isinstance(row["std"], float)), default=None)
    return [row | {"at_one_std": _at_std(row, smallest)} for row in rows]


def _at_std(row: Row, std: float | None) -> float | None:
    if std is None or row["std"] == std or not isinstance(row["std"], float):
        return float(row["held_out"])
    if row["options"]:
        return None
    errors = -2 * row["std"] ** 2 * (row["held_out"] + _normalizer(row["std"]))
    return float(-_normalizer(std) - errors / (2 * std**2))


def _normalizer(std: float) -> float:
    return float(CONTROLS * (np.log(2 * np.pi) / 2 + np.log(std)))


def page(study: str, rows: Sequence[Row], missing: Sequence[str], made_by: str) -> str:
    """The table, the differences, and what has not been measured.

    :param missing: names of cells.
    """
    across = ACROSS[study]
    lines = [made_by, "", "Means over training seeds with 95 % t intervals; the last column is the number of seeds. "]
    lines[-1] += f"Policies from the state, on the same demonstrations and episodes: `{STATE}`."
    ordered = sorted(rows, key=lambda row: (row["method"], -row[across], row["seed"]))
    lines += ["", *table(ordered, COLUMNS, "method", across), "", *differences(rows, across)]
    if on := Counter((row["device"], row["method"]) for row in rows if row.get("device", "cpu") != "cpu"):
        each = ", ".join(f"{count} of {method} on {device}" for (device, method), count in on.items())
        lines += ["", f"Fitted on a GPU, whose last digits are others: {each}."]
    if missing:
        kinds = Counter(name.partition("-")[0] for name in missing)
        left = ", ".join(f"{count} of {method}" for method, count in kinds.items())
        lines += ["", f"Cells that are not measured yet: {left}."]
    return "\n".join(lines) + "\n"


def differences(rows: Sequence[Row], across: str) -> list[str]:
    """Each method minus what it is to be compared with, paired by seed."""
    groups = grouped(rows, "method", across)
    return [
        _against(pairs, WORDS[across].format(method=method, other=called, place=place))
        for (method, place), own in groups.items()
        for other, called in _compared(method, place, across, min(at for name, at in groups if name == method)).items()
        if (pairs := _pairs(own, groups.get(other, [])))
    ]


def _compared(method: str, place: int, across: str, least: int) -> dict[tuple[str, int], str]:
    """The method and place of what a method is compared with, and what that is called: with numbers of
    demonstrations the flat policy of equal size and those in :data:`OTHERS`; with numbers of options the fewest
    that were measured, and for a meta-policy that may act itself the same options without that.
    """
    if across == "count":
        others = {f"{method}_flat": "flat of equal size", **OTHERS.get(method, {})}
        return {(other, place): called for other, called in others.items()}
    alone = method.removesuffix("_hybrid")
    hybrid = {(alone, place): "the same without own control"} if alone != method else {}
    return hybrid | ({(method, least): f"k = {least}"} if place > least else {})


def _pairs(ours: Sequence[Row], theirs: Sequence[Row]) -> list[tuple[Row, Row]]:
    by_seed = {row["seed"]: row for row in theirs}
    return [(row, by_seed[row["seed"]]) for row in ours if row["seed"] in by_seed]


def _against(pairs: Sequence[tuple[Row, Row]], which: str) -> str:
    goals, limited = (_difference(pairs, measure, "{:.1f}") for measure in ("goals", "limited"))
    nats = _difference(pairs, "at_one_std", "{:.3f}")
    found = f"{goals} goals ({limited} with the limit), {nats} held-out nats/step"
    return f"- {which}, paired by seed ({len(pairs)}): {found}."


def _difference(pairs: Sequence[tuple[Row, Row]], measure: str, form: str) -> str:
    mean, half, _ = over_seeds([{measure: ours[measure] - theirs[measure]} for ours, theirs in pairs], measure)
    return form.format(mean) + ("" if np.isnan(half) else f" ± {form.format(half)}")


def draw(study: str, rows: Sequence[Row], path: Path) -> None:
    """Goals, held-out likelihood and the meta-policy's own control against what is varied."""
    across = ACROSS[study]
    measures = {"goals": "goals in 2000 steps", "at_one_std": "held-out nats/step, at one σ"}
    if study == "augmentation":
        measures["own_control"] = "steps under own control"
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (measure, label) in zip(figure.subplots(1, len(measures)), measures.items(), strict=True):
        methods = grouped(rows, "method")
        for (method,), aside, own in zip(methods, _aside(rows, across, len(methods)), methods.values(), strict=True):
            groups = grouped(sorted(own, key=lambda row: row[across]), across)
            found = [over_seeds(group, measure) for group in groups.values()]
            places, means = [place + aside for (place,) in groups], [mean for mean, _, _ in found]
            enough = [len(group) >= FEWEST for group in groups.values()]
            bars = [half if many else np.nan for (_, half, _), many in zip(found, enough, strict=True)]
            line = axes.errorbar(places, means, bars, marker="o", ms=4, capsize=2, label=method)
            each = [(row[across] + aside, row[measure]) for row in own if row[measure] is not None]
            axes.scatter(*zip(*each, strict=True), s=9, color=line[0].get_color(), alpha=0.5)
        axes.set(xlabel={"count": "demonstrations", "options": "options k"}[across], ylabel=label)
        axes.set_xticks(sorted({row[across] for row in rows}))
    if rows:
        figure.axes[0].legend(fontsize=8)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def _aside(rows: Sequence[Row], across: str, methods: int) -> list[float]:
    """How far each method's points are drawn beside their place, so that bars of several can be told apart."""
    places = [row[across] for row in rows]
    return list((np.ptp(places or [0]) or 1) * 0.012 * (np.arange(methods) - (methods - 1) / 2))
