"""One cell of the decay study: a task of Meta-World, a number of demonstrations, a rule and a training seed.

    python studies/arena_decay_cell.py TASK COUNT STEPS SEED [--set KEY=VALUE]... [--runs DIR]

As a cell of the arena, but weights decay by (STEPS / steps of the training demonstrations)², and nothing is played.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from apart import HELD_OUT
from arena_cell import ArenaCell, chosen, fitted_cell, sawyer
from cells import Cell, Settings

DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1}, Path("runs/arena"))


@dataclass(frozen=True)
class DecayCell(Cell):
    """A task, how many demonstrations to train on, with how many steps the decay is 1, and the training seed."""

    script = "arena_decay_cell.py"

    task: str
    count: int
    steps: float
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, and say how likely held-out demonstrations are, and how well options agree with phases on them."""
        own = settings.values
        source = sawyer(settings).collected(
            self.task, number=own["demonstrations"], held_out=HELD_OUT, noise=own["noise"]
        )
        cell = ArenaCell(self.task, self.count, self.seed)
        decay = (self.steps / trained_steps(source, cell)) ** 2
        changes = (*settings.overrides, f"training.optimizer.weight_decay={decay:.3g}")
        fitted = fitted_cell(cell, source, changes, folder)
        rows = [row for row in fitted.metrics["demonstrations_by_likelihood"] if row["part"] == "valid"]
        return {
            "weight_decay": decay,
            "held_out": {
                name: [row["log_likelihood_per_step"][name] for row in rows]
                for name in rows[0]["log_likelihood_per_step"]
            },
            "agreement": fitted.metrics["agreement"]["valid"][0],
        }


def trained_steps(source: Path, cell: ArenaCell) -> int:
    """Steps of the demonstrations that a cell trains on."""
    with h5py.File(source) as file:
        return int(np.sum([len(file[f"data/{name}/actions"]) for name in chosen(source, cell)[0]]))


if __name__ == "__main__":
    DecayCell.main(__doc__, DEFAULTS)
