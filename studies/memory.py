"""The figure of "memory, or several policies": ``docs/results/memory.png``.

    python studies/memory.py

Both differences of every comparison, by the tables that ``needle.yaml``, ``pushing.yaml``, ``pushing_test.yaml``,
``arena.yaml`` and ``bins.yaml`` keep. ``ddco-pyro study render`` quotes the numbers of the pages.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from study import RESULTS, ROOT

from ddco_pyro.drawing.figures import FAINT, blank, save, style
from ddco_pyro.study.declaration import Study
from ddco_pyro.study.report import name_of
from ddco_pyro.study.table import earlier, estimate, values

COLOURS = {"mixture - flat": "#c08a30", "options - mixture": "#1f3f70"}
NAMED = {
    "needle": "needle",
    "pushing": "pushing",
    "pushing_test": "pushing (test)",
    "arena": "Meta-World",
    "bins": "bin picking",
}
Line = tuple[str, int, str]
"""A study, a number of demonstrations and a measure."""


def read() -> dict[str, pd.DataFrame]:
    """The table of each study, by its name."""
    return {name: earlier(Study.load(ROOT / "studies" / f"{name}.yaml", allow_code=True)) for name in NAMED}


def lines(rows: dict[str, pd.DataFrame]) -> list[Line]:
    """Every comparison."""
    return list(dict.fromkeys(
        (study, int(row.demonstrations), row.measure)
        for study, table in rows.items() for row in table.itertuples()
        if row.method == "mixture" and row.measure in ("nats", "nmi", "success", "goals")
    ))  # fmt: skip


def draw(rows: dict[str, pd.DataFrame], chosen: Sequence[Line], path: Path) -> None:
    """Both differences of every comparison, a panel for each measure."""
    groups = {one: [line for line in chosen if line[2] == one] for one in ("nats", "nmi", "success", "goals")}
    groups = {name: group for name, group in groups.items() if group}
    with style():
        high = max(len(group) for group in groups.values())
        figure = blank(1.2 + 0.24 * high * -(-len(groups) // 2))
        panels = figure.subplots(-(-len(groups) // 2), 2, squeeze=False).flatten()
        for axes, (measure, group) in zip(panels, groups.items(), strict=False):
            _panel(axes, measure, group, rows)
        for axes in panels[len(groups) :]:
            axes.set_axis_off()
        named = [one for axes in panels for one in zip(*axes.get_legend_handles_labels(), strict=True)]
        handles = {label: handle for handle, label in named}
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=2)
        save(figure, path, "What several policies are worth, and what it is worth that they last", "")


def _panel(axes: Axes, measure: str, group: Sequence[Line], rows: dict[str, pd.DataFrame]) -> None:
    for place, (study, count, _) in enumerate(group):
        for shift, (contrast, colour) in zip((-0.11, 0.11), COLOURS.items(), strict=True):
            if len(differences := values(rows[study], contrast, measure, [count])):
                found, label = estimate(differences), contrast.replace(" - ", " − ")
                known = label in axes.get_legend_handles_labels()[1]
                axes.plot(found.value, place + shift, "o", ms=4, color=colour, label=None if known else label)
                axes.plot(found.interval, [place + shift] * 2, lw=2, color=colour, alpha=0.6)
    axes.axvline(0, color=FAINT, lw=0.7)
    names = [f"{NAMED[study]} {count}" for study, count, _ in group]
    axes.set(title=name_of(measure), yticks=range(len(group)), yticklabels=names)
    axes.set_ylim(len(group) - 0.5, -0.5)
    if measure == "nats":
        axes.set_xscale("symlog", linthresh=0.1)
        axes.set_xticks([-1, -0.1, 0, 0.1, 1, 5])
        axes.xaxis.set_major_formatter("{x:g}")
    if measure == "success":
        axes.set_xlim(-0.6, 0.6)


if __name__ == "__main__":
    known = read()
    draw(known, lines(known), RESULTS / "memory.png")
