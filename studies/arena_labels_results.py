"""What the cells of the labels study say together: a table, a page and a figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from needle_success import over_seeds, spread

from ddco_pyro.drawing.figures import blank, save, style

SHOWN = ("nmi", "accuracy", "named", "f1_50", "edit", "boundary_f1_3")
COLOURS = ("#1f3f70", "#c0a030", "#3d8a5a", "#a04050", "#7060a8", "#8a8a8a", "#d07020", "#2090a0", "#505050")

Result = dict[str, Any]


def summarize(cells: list[Result]) -> Result:
    """For each number of labelled demonstrations every measure: of each task over seeds, and over tasks."""
    numbers: Result = {}
    for labelled in sorted({cell["labelled"] for cell in cells}):
        own = [cell for cell in cells if cell["labelled"] == labelled]
        tasks = {task: [cell for cell in own if cell["task"] == task] for task in dict.fromkeys(c["task"] for c in own)}
        by_task = {task: {name: over_seeds(values(seeds, name), (0.0, 1.0)) for name in SHOWN}
                   for task, seeds in tasks.items()}  # fmt: skip
        numbers[str(labelled)] = {
            "tasks": by_task,
            "mean": {name: over_seeds([one[name]["mean"] for one in by_task.values()], (0.0, 1.0)) for name in SHOWN},
            "log_likelihood_valid": float(np.mean([cell["log_likelihood_per_step"]["valid"] for cell in own])),
            "not_converged": sum(not cell["converged"] for cell in own),
        }
    return numbers


def values(cells: list[Result], name: str) -> list[float]:
    """A measure of each cell."""
    return [cell["measures"][name] for cell in cells]


def page(results: Result, made_by: str) -> str:
    """The results as Markdown."""
    lines = [
        made_by,
        "",
        "On held-out demonstrations: means over tasks (of means over training seeds) with 95 % t intervals over tasks. "
        "As many options as the expert has phases. `named` is the part of the steps whose option has the number of "
        "their phase, which nothing but labels can give; where nothing is labelled it is chance.",
        "",
        f"| labelled | {' | '.join(SHOWN)} | nats/step held out |",
        "|---" * (len(SHOWN) + 2) + "|",
    ]
    for labelled, found in results.items():
        rising = f", {found['not_converged']} not converged" if found["not_converged"] else ""
        measures = " | ".join(spread(found["mean"][name], "{:.2f}") for name in SHOWN)
        lines.append(f"| {labelled} | {measures} | {found['log_likelihood_valid']:.2f}{rising} |")
    tasks = next(iter(results.values()))["tasks"]
    for name in ("nmi", "named"):
        lines += ["", f"| {name}: labelled | {' | '.join(tasks)} |", "|---" * (len(tasks) + 1) + "|"]
        for labelled, found in results.items():
            cells = [spread(found["tasks"][task][name] | {"interval": None}, "{:.2f}") for task in tasks]
            lines.append(f"| {labelled} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(results: Result, path: Path) -> None:
    """NMI, and the part of the steps with the right name, against labelled demonstrations: each task, and the mean."""
    numbers = list(results)
    with style():
        figure = blank(3.2)
        for axes, name in zip(figure.subplots(1, 2, sharey=True), ("nmi", "named"), strict=True):
            for colour, task in zip(COLOURS, results[numbers[0]]["tasks"], strict=False):
                line = [results[number]["tasks"][task][name]["mean"] for number in numbers]
                axes.plot(range(len(numbers)), line, "o-", ms=3, lw=0.8, color=colour, label=task)
            mean = [results[number]["mean"][name]["mean"] for number in numbers]
            axes.plot(range(len(numbers)), mean, "k-", lw=2, label="mean")
            axes.set(xticks=range(len(numbers)), xticklabels=numbers, xlabel="labelled demonstrations of 50")
            axes.set(ylabel=name, ylim=(0, 1.02))
            axes.grid(axis="y", color="#e4e4e4")
        axes.legend(fontsize=6, ncols=2, frameon=False, loc="lower right")
        save(figure, path, "Agreement with the expert's phases by number of labelled demonstrations", "")
