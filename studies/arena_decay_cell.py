"""One cell of the decay study: a task of Meta-World, a number of demonstrations, a rule and a training seed.

    python studies/arena_decay_cell.py TASK COUNT STEPS SEED [--episodes 20] [--set KEY=VALUE]... [--runs DIR]

As a cell of the arena, but weights decay by (STEPS / steps of the training demonstrations)².
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from apart import HELD_OUT
from arena_cell import ArenaCell, chosen, sawyer
from cells import Cell, Settings

DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1, "episodes": 20}, Path("runs/arena"))


@dataclass(frozen=True)
class DecayCell(Cell):
    """A task, how many demonstrations to train on, with how many steps the decay is 1, and the training seed."""

    script = "arena_decay_cell.py"

    task: str
    count: int
    steps: float
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """What the arena's cell with that decay says."""
        own = settings.values
        source = sawyer(settings).collected(
            self.task, number=own["demonstrations"], held_out=HELD_OUT, noise=own["noise"]
        )
        cell = ArenaCell(self.task, self.count, self.seed)
        decay = (self.steps / trained_steps(source, cell)) ** 2
        changes = (*settings.overrides, f"training.optimizer.weight_decay={decay:.3g}")
        found = cell.results(replace(settings, overrides=changes), folder)
        methods = found["methods"]
        return {
            "weight_decay": decay,
            "held_out": {name: [row["log_likelihood_per_step"][name] for row in found["held_out"]] for name in methods},
            "success": {name: one["success"] for name, one in methods.items()},
            "agreement": found["agreement"]["valid"][0],
        }


def trained_steps(source: Path, cell: ArenaCell) -> int:
    """Steps of the demonstrations that a cell trains on."""
    with h5py.File(source) as file:
        return int(np.sum([len(file[f"data/{name}/actions"]) for name in chosen(source, cell)[0]]))


if __name__ == "__main__":
    DecayCell.main(__doc__, DEFAULTS)
