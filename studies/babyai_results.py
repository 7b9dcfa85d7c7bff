"""What the cells of the BabyAI study say together: tables, a page and a figure."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from babyai_cell import LABELS
from babyai_labels import SUBGOALS
from needle_success import over_seeds, spread

from ddco_pyro.drawing.figures import blank, save, style
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED

METHODS = ("flat", "flat_equal", "one", "two")
PLAYED = ("random", *METHODS, "bot")
COLOURS = {
    "random": "#d8d8d8", "flat": "#8a8a8a", "flat_equal": "#c0a030", "one": "#84a7d3", "two": "#1f3f70",
    "bot": "#3a7d44",
}  # fmt: skip
LEVELS = {"one": ("option",), "two": ("option", "plan")}
"""Names of the levels of options, lowest first."""

Result = dict[str, Any]


def summarize(cells: list[Result]) -> list[Result]:
    """A row for each level and what is said of its progress: every measure over training seeds."""
    rows = []
    for level, progress in dict.fromkeys((cell["level"], cell["progress"]) for cell in cells):
        own = [cell for cell in cells if (cell["level"], cell["progress"]) == (level, progress)]
        rows.append(
            {
                "level": level,
                "progress": progress,
                "bot": own[0]["bot"],
                "methods": {name: _method([cell["methods"][name] for cell in own]) for name in METHODS},
                "success": {name: _success([cell["played"][name]["success"] for cell in own]) for name in PLAYED},
                "minus_flat": {
                    name: over_seeds([_valid(cell, name) - _valid(cell, "flat") for cell in own])
                    for name in METHODS[1:]
                },
                "agreement": {
                    name: [{label: _measures([cell["crossed"][name][place][label] for cell in own]) for label in LABELS}
                           for place in range(len(levels))]
                    for name, levels in LEVELS.items()
                },
                "references": {
                    name: {label: _measures([cell["references"][name][label] for cell in own]) for label in LABELS}
                    for name in own[0]["references"]
                },
                "seconds": over_seeds([cell["seconds"]["all"] for cell in own]),
            }
        )  # fmt: skip
    return rows


def _valid(cell: Result, name: str) -> float:
    return float(cell["methods"][name]["log_likelihood_per_step"]["valid"])


def _method(cells: list[Result]) -> Result:
    return {
        "parameters": cells[0]["parameters"],
        "not_converged": sum(not cell["converged"] for cell in cells),
        "bridge_difference": max(cell["bridge_difference"] for cell in cells),
    } | {f"log_likelihood_{part}": over_seeds([cell["log_likelihood_per_step"][part] for cell in cells])
         for part in ("train", "valid")}  # fmt: skip


def _success(cells: list[list[bool]]) -> Result:
    rates = [sum(episodes) / len(episodes) for episodes in cells]
    return over_seeds(rates, (0.0, 1.0)) | {"successes": sum(map(sum, cells)), "trials": sum(map(len, cells))}


def _measures(cells: list[Result]) -> Result:
    """The measures that ask for no matching, and the others under the global one."""
    unmatched = {name: over_seeds([cell[name] for cell in cells]) for name in UNMATCHED}
    return unmatched | {name: over_seeds([cell["matched_globally"][name] for cell in cells]) for name in MATCHED}


def page(rows: list[Result], made_by: str) -> str:
    """The results as Markdown."""
    differences = (one["bridge_difference"] for row in rows for one in row["methods"].values())
    lines = [
        made_by,
        "",
        "Means over training seeds, with 95 % t intervals where there are several. `hidden`: what has been fulfilled "
        "is not observed; `told`: it is. `one` and `two` have so many levels of options.",
        "",
        "## Held-out nats per step",
        "",
        *_table(["level", "progress", *METHODS], _likelihoods(rows)),
        "",
        "After a mean stands by how much it is above flat, and in brackets the nats per step in training.",
        "",
        "## Success",
        "",
        *_table(["level", "progress", *PLAYED], _successes(rows)),
        "",
        "Of missions that were never demonstrated, the same for all, within 120 steps. "
        f"Actions of exported controllers on a recorded demonstration differ from their fits' by {max(differences):g} "
        "at most.",
        "",
        "## Agreement with what the bot was about, held out",
        "",
        *_table(["level", "progress", "segments", "label", *UNMATCHED, *MATCHED], _agreements(rows)),
        "",
        "Options are matched with labels once for all demonstrations; those matched anew in each are in the cells.",
        "",
        "## The bot",
        "",
        *_table(["level", "episodes", "steps on average", "subgoals", "instructions"], _bots(rows)),
    ]
    return "\n".join(lines) + "\n"


def _table(head: list[str], rows: Iterator[list[str]]) -> list[str]:
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *(f"| {' | '.join(row)} |" for row in rows)]


def _likelihoods(rows: list[Result]) -> Iterator[list[str]]:
    for row in rows:
        cells = []
        for name, one in row["methods"].items():
            more = f"; {spread(row['minus_flat'][name], '{:+.3f}')}" if name in row["minus_flat"] else ""
            late = f", {one['not_converged']} not converged" if one["not_converged"] else ""
            train = spread({"mean": one["log_likelihood_train"]["mean"], "interval": None}, "{:.2f}")
            cells.append(f"{spread(one['log_likelihood_valid'], '{:.3f}')}{more} ({train}){late}")
        yield [row["level"], row["progress"], *cells]


def _successes(rows: list[Result]) -> Iterator[list[str]]:
    for row in rows:
        found = (row["success"][name] for name in PLAYED)
        yield [row["level"], row["progress"], *(f"{one['successes']} of {one['trials']}" for one in found)]


def _agreements(rows: list[Result]) -> Iterator[list[str]]:
    for row in rows:
        named = [
            (f"{name}: {level}", found)
            for name, levels in LEVELS.items()
            for level, found in zip(levels, row["agreement"][name], strict=True)
        ]
        for label in LABELS:
            for name, found in [*named, *row["references"].items()]:
                values = [f"{found[label][measure]['mean']:.2f}" for measure in (*UNMATCHED, *MATCHED)]
                yield [row["level"], row["progress"], name, label, *values]


def _bots(rows: list[Result]) -> Iterator[list[str]]:
    for row in {row["level"]: row for row in rows}.values():
        one, shares = row["bot"], row["bot"]["shares"]
        kinds = ", ".join(
            f"{name} {share:.0%}" for name, share in zip(SUBGOALS, shares["subgoal"], strict=True) if share
        )
        instructions = ", ".join(f"{share:.0%}" for share in shares["mission"] if share)
        mean = sum(one["steps"]) / len(one["steps"])
        yield [row["level"], f"{one['successes']} of {one['attempts']}", f"{mean:.1f}", kinds, instructions]


def draw(rows: list[Result], path: Path) -> None:
    """Success of each method, and NMI of each level's options with its own label, by level."""
    shown = [("one", 0, "subgoal", "o", "#84a7d3"), ("two", 0, "subgoal", "o", "#1f3f70"),
             ("two", 1, "mission", "s", "#1f3f70")]  # fmt: skip
    with style():
        figure = blank(1.0 + 0.5 * len(rows))
        left, right = figure.subplots(1, 2, sharey=True)
        for number, row in enumerate(rows):
            for place, name in enumerate(PLAYED):
                values, label = row["success"][name]["by_seed"], name if number == 0 else None
                height = number + 0.12 * (place - len(PLAYED) / 2)
                left.plot(values, [height] * len(values), "o", ms=4, color=COLOURS[name], label=label)
            for place, (name, level, of, marker, colour) in enumerate(shown):
                values = row["agreement"][name][level][of]["nmi"]["by_seed"]
                label = f"{name}: {LEVELS[name][level]}, {of}" if number == 0 else None
                right.plot(values, [number + 0.15 * (place - 1)] * len(values), marker, ms=4, color=colour, label=label)
            for of, height in (("subgoal", -0.07), ("mission", 0.15)):
                label = "k-means" if (number, of) == (0, "subgoal") else None
                value = row["references"]["kmeans"][of]["nmi"]["mean"]
                right.plot(value, number + height, "|", ms=9, color="#c06030", label=label)
        names = [f"{row['level']}, {row['progress']}" for row in rows]
        left.set(yticks=range(len(rows)), yticklabels=names, ylim=(len(rows) - 0.5, -0.5), xlabel="success rate")
        right.set(xlabel="held-out NMI of options with the bot's labels")
        for axes in (left, right):
            axes.set(xlim=(-0.02, 1.02))
            axes.grid(axis="x", color="#e4e4e4")
            axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, fontsize=7, frameon=False)
        save(figure, path, "Success, and agreement of options with the bot's subgoals and instructions, by level", "")
