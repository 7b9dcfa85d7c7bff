"""How many labelled demonstrations name and place the options of fifty, on tasks of Meta-World with several phases.

    python studies/arena_labels.py [--tasks pick-place-v3 ...] [--labelled 0 1 3 10] [--seeds 2] [--jobs 2]
        [--set KEY=VALUE]... [--demonstrations 70] [--noise 0.1] [--out DIR] [--runs DIR]

With the demonstrations and the environment of ``studies/arena.py``. A cell (task, labelled demonstrations, seed) that
was done with these settings is not done again. Adds its numbers to ``docs/results/arena.csv``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import study
from arena import LABELS, TASKS, ArenaCell, fitted_cell, flat, recorded, sawyer
from study import Cell, Row, Settings, described

from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.training.data import parts

TRAINED = 50
DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1}, Path("runs/arena"))


@dataclass(frozen=True)
class LabelsCell(Cell):
    """A task, how many demonstrations have their labels, and the seed that chooses them and trains."""

    task: str
    labelled: int
    seed: int

    def __post_init__(self) -> None:
        """:raises BadInput: there are not so many demonstrations to label."""
        if not 0 <= self.labelled <= TRAINED:
            raise BadInput(
                f"{self.labelled} labelled demonstrations: it has to be 0 to {TRAINED}, which are trained on"
            )

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, and say how well options agree with phases on held-out demonstrations."""
        source = recorded(self.task, settings)
        kinds = phases(source)
        changes = [*settings.overrides, "compare_with=[]", f"hierarchy.levels.0.count={len(kinds)}"]
        if self.labelled:
            changes.append(f"training.labels={{level: option, from: {LABELS}, count: {self.labelled}}}")
        fitted = fitted_cell(ArenaCell(self.task, TRAINED, self.seed), source, tuple(changes), folder)
        return {
            "phases": len(kinds),
            "log_likelihood_per_step": fitted.metrics.log_likelihood_per_step.model_dump(),
            "converged": fitted.metrics.training.converged,
            "measures": measured(fitted, kinds),
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Agreement with the phases, and the part of the steps that have the right name."""
        for measure in ("nmi", "accuracy", "named", "f1_50"):
            name = "NMI" if measure == "nmi" else measure
            method = f"{self.labelled} labelled"
            yield Row("labels", self.task, method, TRAINED, self.seed, name, results["measures"][measure])


def phases(source: Path) -> list[int]:
    """The labels of a file of demonstrations that are phases, sorted: option 1 is the first of them."""
    with h5py.File(source) as file:
        return sorted({int(label) for demo in file["data"].values() for label in demo[f"labels/{LABELS}"][()]} - {-1})


def measured(fitted: Fit, kinds: list[int]) -> dict[str, float]:
    """Measures on held-out demonstrations; ``named``: the part of the steps whose option stands for their phase.

    Options that no label names, because it was in none of the labelled demonstrations, are wrong; where nothing is
    labelled, options stand for phases by their numbers.
    """
    valid = parts(fitted.spec, fitted.demonstrations)["valid"]
    truth = [demo.labels[LABELS] for demo in valid]
    segments = fitted.segment(valid)[0]
    trained = fitted.metrics.trained_labels
    names = dict(enumerate(trained.values if trained else kinds, start=1))
    right = [names.get(option) == phase for own, phases in zip(segments, truth, strict=True)
             for option, phase in zip(own.tolist(), phases.tolist(), strict=True)]  # fmt: skip
    return flat(agreement(segments, truth)) | {"named": float(np.mean(right))}


def cells(own: argparse.Namespace) -> list[LabelsCell]:
    """All of a seed before another."""
    product = itertools.product(range(own.seeds), own.labelled, own.tasks)
    return [LabelsCell(task, labelled, seed) for seed, labelled, task in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK")
    parser.add_argument("--labelled", type=int, nargs="+", default=[0, 1, 3, 10])
    parser.add_argument("--seeds", type=int, default=2)
    study.main("arena", parser, DEFAULTS, cells, lambda settings: sawyer(settings).made())


if __name__ == "__main__":
    main()
