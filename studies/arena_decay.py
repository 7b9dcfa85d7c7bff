"""What weights that decay do with few demonstrations: likelihood, segments and success, on development seeds.

    python studies/arena_decay.py [--tasks pick-place-v3 ...] [--counts 5 10 20] [--steps 0 80 250] [--seeds 101]
        [--episodes 20] [--jobs 2] [--set KEY=VALUE]... [--demonstrations 70] [--noise 0.1] [--out DIR] [--runs DIR]

With the demonstrations and the environment of ``studies/arena.py``. Weights decay by (STEPS / steps of the training
demonstrations)², those of policies without options too. A cell that this code has done with these settings is not done
again. Writes ``summary.json``, ``summary.md`` and ``arena_decay.png``.
"""

from __future__ import annotations

import argparse
import itertools

import arena_decay_cell
import arena_decay_results
from arena import TASKS
from arena_cell import sawyer
from cells import Cell, described
from study import Study

DEVELOPED = ("pick-place-v3", "disassemble-v3", "basketball-v3", "stick-pull-v3", "hand-insert-v3", "sweep-into-v3")


def cells(own: argparse.Namespace) -> list[Cell]:
    """All of a seed before another."""
    product = itertools.product(own.seeds, own.counts, own.steps, own.tasks)
    return [arena_decay_cell.DecayCell(task, count, steps, seed) for seed, count, steps, task in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(DEVELOPED), choices=TASKS, metavar="TASK")
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 10, 20])
    parser.add_argument("--steps", type=float, nargs="+", default=[0, 80, 250])
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    axes = ("tasks", "counts", "steps", "seeds")
    defaults = arena_decay_cell.DEFAULTS
    Study("arena_decay", axes, cells, sawyer, arena_decay_results, defaults, jobs=2).main(parser)


if __name__ == "__main__":
    main()
