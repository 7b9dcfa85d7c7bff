"""Segments and success on tasks of Meta-World with several phases, over numbers of demonstrations and training seeds.

    python studies/arena.py [--tasks pick-place-v3 ...] [--counts 5 10 20 50] [--seeds 5] [--episodes 50] [--jobs 2]
        [--set KEY=VALUE]... [--demonstrations 70] [--noise 0.1] [--out DIR] [--runs DIR]

Records the demonstrations of Meta-World's scripted experts in an environment of its own (``RUNS/venv``), fits what
``ddco-pyro init`` writes for them, and lets ddco, flat and flat_equal act. A cell (task, number, seed) that was done
with these settings is not done again. Adds its numbers to ``docs/results/arena.csv``.
"""

from __future__ import annotations

import argparse
import itertools

import arena_cell
import study
from cells import Cell, described

TASKS = tuple(
    f"{name}-v3"
    for name in (
        "pick-place", "assembly", "shelf-place", "stick-pull", "hammer", "disassemble", "basketball", "hand-insert",
        "sweep-into",
    )
)  # fmt: skip


def cells(own: argparse.Namespace) -> list[Cell]:
    """All tasks with few demonstrations before any with more; all of a seed before another."""
    product = itertools.product(range(own.seeds), own.counts, own.tasks)
    return [arena_cell.ArenaCell(task, count, seed) for seed, count, task in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK")
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 10, 20, 50])
    parser.add_argument("--seeds", type=int, default=5)
    study.main("arena", parser, arena_cell.DEFAULTS, cells, lambda settings: arena_cell.sawyer(settings).made())


if __name__ == "__main__":
    main()
