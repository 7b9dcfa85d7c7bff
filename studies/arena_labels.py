"""How many labelled demonstrations name and place the options of fifty, on tasks of Meta-World with several phases.

    python studies/arena_labels.py [--tasks pick-place-v3 ...] [--labelled 0 1 3 10] [--seeds 2] [--jobs 2]
        [--set KEY=VALUE]... [--demonstrations 70] [--noise 0.1] [--out DIR] [--runs DIR]

With the demonstrations and the environment of ``studies/arena.py``. A cell (task, labelled demonstrations, seed) that
was done with these settings is not done again. Adds its numbers to ``docs/results/arena.csv``.
"""

from __future__ import annotations

import argparse
import itertools

import arena_labels_cell
import study
from arena import TASKS
from arena_cell import sawyer
from cells import Cell, described


def cells(own: argparse.Namespace) -> list[Cell]:
    """All of a seed before another."""
    product = itertools.product(range(own.seeds), own.labelled, own.tasks)
    return [arena_labels_cell.LabelsCell(task, labelled, seed) for seed, labelled, task in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK")
    parser.add_argument("--labelled", type=int, nargs="+", default=[0, 1, 3, 10])
    parser.add_argument("--seeds", type=int, default=2)
    study.main("arena", parser, arena_labels_cell.DEFAULTS, cells, lambda settings: sawyer(settings).made())


if __name__ == "__main__":
    main()
