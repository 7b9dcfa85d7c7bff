"""One cell of the labels study: a task of Meta-World, a number of labelled demonstrations and a training seed.

    python studies/arena_labels_cell.py TASK LABELLED SEED [--set KEY=VALUE]... [--runs DIR]

As a cell of the arena with 50 demonstrations, but with as many options as the expert has phases, and the phases of so
many demonstrations given to training.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from arena_cell import LABELS, ArenaCell, fitted_cell, recorded
from arena_segments import flat
from cells import Cell, Settings
from table import Row

from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.training.data import parts

TRAINED = 50
DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1}, Path("runs/arena"))


@dataclass(frozen=True)
class LabelsCell(Cell):
    """A task, how many demonstrations have their labels, and the seed that chooses them and trains."""

    script = "arena_labels_cell.py"

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


if __name__ == "__main__":
    LabelsCell.main(__doc__, DEFAULTS)
