"""What the cells of the decay study say together: a table, a page and a figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from arena_results import COLOURS, OURS

from ddco_pyro.drawing.figures import blank, save, style

Result = dict[str, Any]


def summarize(cells: list[Result]) -> Result:
    """For each number of demonstrations and each rule, means over tasks and training seeds."""
    counts: Result = {}
    for count in sorted({cell["count"] for cell in cells}):
        own = [cell for cell in cells if cell["count"] == count]
        rules = {steps: [cell for cell in own if cell["steps"] == steps] for steps in sorted({c["steps"] for c in own})}
        counts[str(count)] = {f"{steps:g}": _summary(fits) for steps, fits in rules.items()}
    return counts


def _summary(cells: list[Result]) -> Result:
    methods = list(cells[0]["held_out"])
    return {
        "fits": len(cells),
        "weight_decay": float(np.median([cell["weight_decay"] for cell in cells])),
        "mean": {name: float(np.mean([np.mean(cell["held_out"][name]) for cell in cells])) for name in methods},
        "median": {name: float(np.mean([np.median(cell["held_out"][name]) for cell in cells])) for name in methods},
        "success": {name: _counted([cell["success"][name] for cell in cells]) for name in methods},
        "nmi": float(np.mean([cell["agreement"]["nmi"] for cell in cells])),
        "f1_50": float(np.mean([cell["agreement"]["matched_globally"]["f1_50"] for cell in cells])),
    }


def _counted(played: list[list[bool]]) -> dict[str, int]:
    return {"successes": sum(map(sum, played)), "trials": sum(map(len, played))}


def _rate(found: Result, name: str) -> float:
    return float(found["success"][name]["successes"] / found["success"][name]["trials"])


def page(results: Result, made_by: str) -> str:
    """The results as Markdown."""
    methods = list(next(iter(next(iter(results.values())).values()))["mean"])
    head = ["demonstrations", "steps", "decay", *(f"{name}, nats" for name in methods), "NMI", "F1@50"]
    head += [f"success {name}" for name in methods]
    lines = [
        made_by,
        "",
        "Weights decay by (steps / those of the training demonstrations)², of which the median over fits is given; 0: "
        "they do not. Nats per step held out: the mean over fits of a fit's mean over demonstrations, and of its "
        "median over them: a few demonstrations that are very unlikely decide the first. Then the options' agreement "
        "with the expert's phases, and successes in Meta-World, every method from the same starts.",
        "",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
    ]
    for count, rules in results.items():
        for steps, found in rules.items():
            cells = [count, steps, f"{found['weight_decay']:.2g}"]
            cells += [f"{found['mean'][name]:.2f}; {found['median'][name]:.2f}" for name in methods]
            cells += [f"{found[name]:.2f}" for name in ("nmi", "f1_50")]
            cells += ["{successes} of {trials}".format(**found["success"][name]) for name in methods]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(results: Result, path: Path) -> None:
    """Nats of the median demonstration, success, and NMI by rule: a column for each number of demonstrations."""
    shown = (
        ("nats per step, median", COLOURS, lambda found, name: found["median"][name]),
        ("success", COLOURS, _rate),
        ("NMI with phases", {OURS: COLOURS[OURS]}, lambda found, _: found["nmi"]),
    )
    with style():
        figure = blank(5.6)
        grid = figure.subplots(len(shown), len(results), sharex=True, sharey="row", squeeze=False)
        for row, (label, colours, value) in zip(grid, shown, strict=True):
            row[0].set_ylabel(label)
            for axes, rules in zip(row, results.values(), strict=True):
                axes.grid(axis="y", color="#e4e4e4")
                for name, colour in colours.items():
                    line = [value(found, name) for found in rules.values()]
                    axes.plot(range(len(rules)), line, "o-", ms=3, color=colour, label=name)
        for axes, rules in zip(grid[-1], results.values(), strict=True):
            axes.set(xticks=range(len(rules)), xticklabels=list(rules), xlabel="steps with which the decay is 1")
        for axes, count in zip(grid[0], results, strict=True):
            axes.set_title(f"{count} demonstrations", fontsize=8)
        grid[0, -1].legend(fontsize=6, frameon=False)
        save(figure, path, "Held-out likelihood, success and agreement by how much weights decay", "")
