"""Options at two levels on BabyAI, whose bot keeps a stack of subgoals: truth for both of them.

    python studies/babyai.py [--levels GoToSeqS5R2 ...] [--progress hidden told] [--seeds 2] [--episodes 50] [--jobs 1]
        [--set KEY=VALUE]... [--demonstrations 80] [--out DIR] [--runs DIR]

Records minigrid's bot in an environment of its own (``RUNS/venv``), fits one level of options, two, and policies
without options, and lets them act. A cell (level, progress, seed) that this code has done with these settings is not
done again. Writes ``summary.json``, ``summary.md`` and ``babyai.png``.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import babyai_cell
from babyai_results import draw, page, summarize
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.errors import BadInput, Failed

LEVELS = ("GoToSeqS5R2", "MoveTwoAcrossS5N2", "MiniBossLevel")


def run(own: argparse.Namespace) -> str:
    """The study; its page."""
    settings = babyai_cell.settings(own)
    cells = [
        babyai_cell.Cell(level, progress, seed)
        for seed, level, progress in itertools.product(range(own.seeds), own.levels, own.progress)
    ]
    made_by = record(cells[0].command(settings))
    babyai_cell.gridworld(settings).made()  # or nothing else has to begin
    kept = Parallel(n_jobs=own.jobs, verbose=10)(delayed(babyai_cell.run)(cell, settings, made_by) for cell in cells)
    results = summarize([one["results"] for one in kept])
    records = [one["provenance"][0] for one in kept]
    words = f"--levels {' '.join(own.levels)} --progress {' '.join(own.progress)} --seeds {own.seeds}"
    summary = page(results, sentence(f"python studies/babyai.py {words} {settings.words()}", records))
    write_text(own.out / "summary.json", text(results, records))
    write_text(own.out / "summary.md", summary)
    draw(results, own.out / "babyai.png")
    return summary


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), metavar="LEVEL")
    parser.add_argument("--progress", nargs="+", choices=babyai_cell.PROGRESS, default=list(babyai_cell.PROGRESS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time; each works on one thread")
    parser.add_argument("--out", type=Path, default=Path("docs/results/babyai"))
    babyai_cell.add_settings(parser)
    try:
        print(run(parser.parse_args()))
    except (BadInput, Failed) as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
