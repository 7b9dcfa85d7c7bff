"""Options at two levels on BabyAI, whose bot keeps a stack of subgoals: truth for both of them.

    python studies/babyai.py [--levels GoToSeqS5R2 ...] [--progress hidden told] [--seeds 2] [--episodes 50] [--jobs 1]
        [--set KEY=VALUE]... [--demonstrations 80] [--out DIR] [--runs DIR]

Records minigrid's bot in an environment of its own (``RUNS/venv``), fits one level of options, two, and policies
without options, and lets them act. A cell (level, progress, seed) that was done with these settings is not done
again. Adds its numbers to ``docs/results/babyai.csv``.
"""

from __future__ import annotations

import argparse
import itertools

import babyai_cell
import study
from cells import Cell, described

LEVELS = ("GoToSeqS5R2", "MoveTwoAcrossS5N2", "MiniBossLevel")


def cells(own: argparse.Namespace) -> list[Cell]:
    """All of a seed before another."""
    product = itertools.product(range(own.seeds), own.levels, own.progress)
    return [babyai_cell.BabyAICell(level, progress, seed) for seed, level, progress in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), metavar="LEVEL")
    parser.add_argument("--progress", nargs="+", choices=babyai_cell.PROGRESS, default=list(babyai_cell.PROGRESS))
    parser.add_argument("--seeds", type=int, default=2)
    defaults = babyai_cell.DEFAULTS
    study.main("babyai", parser, defaults, cells, lambda settings: babyai_cell.gridworld(settings).made())


if __name__ == "__main__":
    main()
