"""Agreement of segments with phases over the arena's tasks: options beside segmentation without a hierarchy."""

from __future__ import annotations

from typing import Any

import numpy as np
from needle_success import over_seeds, spread
from scipy import stats

from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Scores as Measures
from ddco_pyro.segmenting.baselines import BASELINES, segment
from ddco_pyro.training.data import parts

OURS = "ddco"
MEASURES = ("nmi", "ari", "accuracy", "iou", "f1_10", "f1_25", "f1_50", "edit", "boundary_f1_1", "boundary_f1_3",
            "boundary_f1_5")  # fmt: skip
Scores = dict[str, float]


def scored(fitted: Fit, labels: str) -> dict[str, Scores]:
    """Measures on held-out demonstrations of the lowest level's options and of every baseline with as many kinds."""
    train, valid = parts(fitted.spec, fitted.demonstrations).values()
    hierarchy, truth = fitted.spec.hierarchy, [demo.labels[labels] for demo in valid]
    assert hierarchy is not None  # it is what init writes
    count, observations = hierarchy.levels[0].count, fitted.spec.observations
    segments = {OURS: [own[own >= 0] for own in fitted.segment(valid)[0]]}
    segments |= {name: segment(name, train, valid, count, fitted.spec.seed, observations) for name in BASELINES}
    return {name: flat(agreement(own, truth)) for name, own in segments.items()}


def flat(measures: Measures | None) -> Scores:
    """Each measure as a number, options matched globally where they are."""
    assert measures is not None  # every step of the arena has a phase
    both = dict(measures) | dict(measures.matched_globally)
    return {name: float(both[name]) for name in MEASURES}


def compared(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """For every measure the mean over tasks of each method, and ours minus each of the others, paired by task.

    What a method has on a task is its mean over training seeds; intervals and Wilcoxon's p are over tasks.
    """
    tasks = list(dict.fromkeys(cell["task"] for cell in cells))
    methods = list(cells[0]["segments"])
    table = {}
    for measure in MEASURES:
        by_task = {
            name: [np.mean([cell["segments"][name][measure] for cell in cells if cell["task"] == task])
                   for task in tasks]
            for name in methods
        }  # fmt: skip
        table[measure] = {
            "methods": {name: over_seeds([float(value) for value in own]) for name, own in by_task.items()},
            "difference": {name: paired(by_task[OURS], by_task[name]) for name in methods if name != OURS},
        }
    return {"tasks": tasks, "measures": table}


def paired(ours: list[Any], theirs: list[Any]) -> dict[str, Any]:
    """Ours minus theirs over tasks, [tasks] each, on how many tasks ours is more, and Wilcoxon's p."""
    values = np.subtract(ours, theirs)
    p = float(stats.wilcoxon(values).pvalue) if np.any(values) else 1.0
    return over_seeds([float(value) for value in values]) | {"wins": int((values > 0).sum()), "wilcoxon_p": p}


def shown(difference: dict[str, Any], form: str) -> str:
    """What :func:`paired` says."""
    return f"{spread(difference, form)}; {difference['wins']}; p = {difference['wilcoxon_p']:.2g}"


def page(table: dict[str, Any]) -> list[str]:
    """Lines of Markdown: means over tasks, and the paired differences."""
    tasks, measures = table["tasks"], table["measures"]
    methods = list(next(iter(measures.values()))["methods"])
    lines = [
        f"Segments on held-out demonstrations: means over {len(tasks)} tasks (of means over training seeds). Below, "
        f"{OURS} minus each of the others, paired by task, with 95 % t intervals over tasks, on how many tasks "
        f"{OURS} is better, and Wilcoxon's p. Every method is given the same number of kinds.",
        "",
        f"| method | {' | '.join(MEASURES)} |",
        "|---" * (len(MEASURES) + 1) + "|",
    ]
    lines += [
        f"| {name} | {' | '.join(format(measures[one]['methods'][name]['mean'], '.2f') for one in MEASURES)} |"
        for name in methods
    ]
    lines += ["", f"| {OURS} minus | {' | '.join(MEASURES)} |", "|---" * (len(MEASURES) + 1) + "|"]
    for name in methods[1:]:
        cells = [shown(measures[one]["difference"][name], "{:+.2f}") for one in MEASURES]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines
