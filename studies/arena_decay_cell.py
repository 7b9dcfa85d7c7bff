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
from arena_cell import ArenaCell, chosen, recorded
from cells import Cell, Settings

from ddco_pyro.errors import BadInput

DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1, "episodes": 20}, Path("runs/arena"))


@dataclass(frozen=True)
class DecayCell(Cell):
    """A task, how many demonstrations to train on, with how many steps the decay is 1, and the training seed."""

    script = "arena_decay_cell.py"

    task: str
    count: int
    steps: float
    seed: int

    def __post_init__(self) -> None:
        """:raises BadInput: steps are counted."""
        if self.steps < 0:
            raise BadInput(f"a decay that is 1 with {self.steps:g} steps: it has to be 0 or more")

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """What the arena's cell with that decay says."""
        source = recorded(self.task, settings)
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
