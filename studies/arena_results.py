"""What the arena's cells say together: a table, a page and a figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import arena_segments
import numpy as np
from matplotlib.axes import Axes
from needle_success import over_seeds, spread

from ddco_pyro.drawing.figures import blank, save, style

OURS = "ddco"
RARE = 0.01
"""A phase with fewer of the steps is rare."""

COLOURS = {"ddco": "#1f3f70", "flat": "#8a8a8a", "flat_equal": "#c0a030"}
SHADES = ("#b9cbe4", "#84a7d3", "#3f6fb0", "#1f3f70")

Result = dict[str, Any]


def summarize(cells: list[Result]) -> Result:
    """For each task its expert, and for each number of demonstrations every measure over training seeds."""
    tasks: Result = {}
    for task in dict.fromkeys(cell["task"] for cell in cells):
        own = [cell for cell in cells if cell["task"] == task]
        counts = sorted({cell["count"] for cell in own})
        tasks[task] = {
            "expert": own[0]["expert"],
            "counts": {str(count): _summary([cell for cell in own if cell["count"] == count]) for count in counts},
        }
    segments = {
        str(count): arena_segments.compared([cell for cell in cells if cell["count"] == count])
        for count in sorted({cell["count"] for cell in cells})
    }
    return {"tasks": tasks, "segments": segments}


def _summary(cells: list[Result]) -> Result:
    methods = list(cells[0]["methods"])
    others = [name for name in methods if name != OURS]
    return {
        "nmi_valid": over_seeds([nmi(cell["agreement"]) for cell in cells], (0.0, 1.0)),
        "methods": {name: _method([cell["methods"][name] for cell in cells]) for name in methods},
        "difference": {
            name: over_seeds([cell["difference"][name]["nats_per_step"] for cell in cells]) for name in others
        },
        "better": {name: _better([row for cell in cells for row in cell["held_out"]], name) for name in others},
        "agreement": [cell["agreement"] for cell in cells],
        "seconds": over_seeds([cell["seconds"]["all"] for cell in cells]),
    }


def _method(cells: list[Result]) -> Result:
    successes = [sum(cell["success"]) for cell in cells]
    trials = [len(cell["success"]) for cell in cells]
    rates = [count / of for count, of in zip(successes, trials, strict=True)]
    return {
        "success": over_seeds(rates, (0.0, 1.0)) | {"successes": sum(successes), "trials": sum(trials)},
        "log_likelihood_valid": over_seeds([cell["log_likelihood_per_step"]["valid"] for cell in cells]),
        "not_converged": sum(not cell["converged"] for cell in cells),
        "bridge_difference": max(cell["bridge_difference"] for cell in cells),
    }


def _better(held_out: list[Result], name: str) -> float:
    """Part of the held-out demonstrations that are likelier under ours: few very unlikely ones decide the mean."""
    rows = [row["log_likelihood_per_step"] for row in held_out]
    return sum(row[OURS] > row[name] for row in rows) / len(rows)


def nmi(agreement: Result) -> float:
    """Held-out NMI of the lowest level's segments with the phases."""
    lowest = agreement["valid"][0]  # a number, or a table of measures
    return float(lowest["nmi"] if isinstance(lowest, dict) else lowest)


def page(results: Result, made_by: str) -> str:
    """The results as Markdown."""
    tasks = results["tasks"]
    first = next(iter(next(iter(tasks.values()))["counts"].values()))
    methods, others = list(first["methods"]), list(first["difference"])
    head = ["task", "demonstrations", "NMI held out", f"nats/step held out, {OURS}"]
    head += [*(f"minus {name}" for name in others), *(f"success {name}" for name in methods), "seconds"]
    lines = [
        made_by,
        "",
        "Means over training seeds, with 95 % t intervals where there are several. Every method acts from the same "
        "initial states, none of which was demonstrated, and has to succeed within Meta-World's 500 steps. Seconds are "
        "those of a cell on one thread: a fit of all methods, and their episodes. After a difference stands which part "
        f"of the held-out demonstrations is likelier under {OURS}: a few that are very unlikely decide the mean.",
        "",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
    ]
    for task, one in tasks.items():
        for count, found in one["counts"].items():
            cells = [task, count, spread(found["nmi_valid"], "{:.2f}")]
            cells += [_likelihood(found["methods"][OURS])]
            cells += [f"{spread(found['difference'][name], '{:+.2f}')}; {found['better'][name]:.0%}" for name in others]
            cells += [_success(found["methods"][name]["success"]) for name in methods]
            lines.append(f"| {' | '.join([*cells, spread(found['seconds'], '{:.0f}')])} |")
    lines += [
        "",
        "| task | the expert succeeds | share of the steps of each phase, by line of its code |",
        "|---|---|---|",
    ]
    lines += [f"| {task} | {_expert(one['expert'])} |" for task, one in tasks.items()]
    for count, table in results["segments"].items():
        lines += ["", f"## Success with {count} demonstrations", "", *_successes(tasks, count)]
        lines += ["", f"## Segments with {count} demonstrations", "", *arena_segments.page(table)]
    different = [found["methods"][name]["bridge_difference"] for one in tasks.values()
                 for found in one["counts"].values() for name in methods]  # fmt: skip
    lines += [
        "",
        f"On a recorded demonstration exported controllers differ from their fits by {max(different):.0e} at most.",
    ]
    return "\n".join(lines) + "\n"


def _likelihood(one: Result) -> str:
    rising = f", {one['not_converged']} not converged" if one["not_converged"] else ""
    return spread(one["log_likelihood_valid"], "{:.2f}") + rising


def _success(one: Result) -> str:
    return f"{one['successes']} of {one['trials']}" + (f", {spread(one, '{:.0%}')}" if one["interval"] else "")


def _successes(tasks: Result, count: str) -> list[str]:
    """Lines of Markdown: how often each method succeeds in all, and ours minus each of the others, paired by task."""
    found = [one["counts"][count]["methods"] for one in tasks.values() if count in one["counts"]]
    lines = [
        f"Episodes of {len(found)} tasks and all training seeds; {OURS} minus each of the others, paired by task (of "
        "means over training seeds), with 95 % t intervals over tasks, on how many tasks it is better, and "
        "Wilcoxon's p.",
        "",
        f"| method | succeeds | {OURS} minus it |",
        "|---|---|---|",
    ]
    for name in found[0]:
        own = [one[name]["success"] for one in found]
        counts = f"{sum(one['successes'] for one in own)} of {sum(one['trials'] for one in own)}"
        ours, theirs = ([one[method]["success"]["mean"] for one in found] for method in (OURS, name))
        difference = "-" if name == OURS else arena_segments.shown(arena_segments.paired(ours, theirs), "{:+.1%}")
        lines.append(f"| {name} | {counts} | {difference} |")
    return lines


def _expert(one: Result) -> str:
    shares = ", ".join(f"{share:.0%}" if share >= RARE else f"{share:.1%} (rare)" for share in one["shares"]["phase"])
    return f"{one['successes']} of {one['attempts']} | {shares}"


def draw(results: Result, path: Path) -> None:
    """By task NMI for each number of demonstrations, and success with the most; success over numbers of them."""
    tasks = results["tasks"]
    with style():
        figure = blank(0.8 + 0.45 * len(tasks))
        left, middle, right = figure.subplots(1, 3)
        _agreement(left, tasks)
        _success_by_task(middle, tasks)
        _success_by_count(right, tasks)
        for axes in (left, middle):
            axes.set(yticks=range(len(tasks)), yticklabels=[], xlim=(-0.02, 1.02), ylim=(len(tasks) - 0.5, -0.5))
            axes.grid(axis="x", color="#e4e4e4")
        left.set_yticklabels(list(tasks))
        for axes in (left, middle, right):
            axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize=7, frameon=False)
        save(figure, path, "Agreement of options with the expert's phases, and success", "")


def _agreement(axes: Axes, tasks: Result) -> None:
    for row, one in enumerate(tasks.values()):
        shades = SHADES[-len(one["counts"]) :]
        for shade, (count, found) in zip(shades, one["counts"].items(), strict=False):
            values = found["nmi_valid"]["by_seed"]
            label = f"{count} demonstrations" if row == 0 else None
            axes.plot(values, [row] * len(values), "o", ms=5, color=shade, label=label)
    axes.set_xlabel("held-out NMI with phases (dots: seeds)")


def _success_by_task(axes: Axes, tasks: Result) -> None:
    for row, one in enumerate(tasks.values()):
        most = list(one["counts"].values())[-1]["methods"]
        for place, (name, found) in enumerate(most.items()):
            values, height = found["success"]["by_seed"], row + 0.2 * (place - 1)
            axes.plot(values, [height] * len(values), "o", ms=4, alpha=0.6, color=COLOURS[name])
            mean, label = found["success"]["mean"], name if row == 0 else None
            axes.plot(mean, height, "|", ms=9, mew=2, color=COLOURS[name], label=label)
    axes.set_xlabel("success rate, most demonstrations")


def _success_by_count(axes: Axes, tasks: Result) -> None:
    """No interval: tasks differ by more than methods do, whose paired differences the page has."""
    counts = list(next(iter(tasks.values()))["counts"])
    for name, rates in mean_success(tasks).items():
        axes.plot(range(len(counts)), rates, "o-", ms=4, color=COLOURS[name], label=name)
    axes.set(xticks=range(len(counts)), xticklabels=counts, ylim=(0, 1.02))
    axes.set(xlabel="demonstrations", ylabel="success rate, mean over tasks")


def mean_success(tasks: Result) -> dict[str, list[float]]:
    """Each method's success rate for each number of demonstrations, in the mean over tasks of means over seeds."""
    counted = [one["counts"] for one in tasks.values()]
    first = counted[0]
    return {
        name: [np.mean([one[count]["methods"][name]["success"]["mean"] for one in counted]).item() for count in first]
        for name in next(iter(first.values()))["methods"]
    }
