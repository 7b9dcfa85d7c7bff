"""Segments and success on tasks of Meta-World with several phases, over numbers of demonstrations and training seeds.

    python studies/arena.py [--tasks pick-place-v3 ...] [--counts 5 10 20 50] [--seeds 5] [--episodes 50] [--jobs 2]
        [--set KEY=VALUE]... [--demonstrations 70] [--noise 0.1] [--out DIR] [--runs DIR]

Records the demonstrations of Meta-World's scripted experts in an environment of its own (``RUNS/venv``), fits what
``ddco-pyro init`` writes for them, and lets ddco, flat and flat_equal act. A cell (task, number, seed) that this code
has done with these settings is not done again. Writes ``summary.json``, ``summary.md`` and ``arena.png``.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import arena_cell
from arena_results import draw, page, summarize
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.errors import BadInput, Failed

TASKS = tuple(
    f"{name}-v3"
    for name in (
        "pick-place", "assembly", "shelf-place", "stick-pull", "hammer", "disassemble", "basketball", "hand-insert",
        "sweep-into",
    )
)  # fmt: skip


def run(own: argparse.Namespace) -> str:
    """The study; its page."""
    settings = arena_cell.settings(own)
    cells = [
        arena_cell.Cell(task, count, seed)
        for seed, count, task in itertools.product(range(own.seeds), own.counts, own.tasks)
    ]
    made_by = record(cells[0].command(settings))
    arena_cell.sawyer(settings).made()  # or nothing else has to begin
    kept = Parallel(n_jobs=own.jobs, verbose=10)(delayed(arena_cell.run)(cell, settings, made_by) for cell in cells)
    results = summarize([one["results"] for one in kept])
    records = [one["provenance"][0] for one in kept]
    words = f"--tasks {' '.join(own.tasks)} --counts {' '.join(map(str, own.counts))} --seeds {own.seeds}"
    summary = page(results, sentence(f"python studies/arena.py {words} {settings.words()}", records))
    write_text(own.out / "summary.json", text(results, records))
    write_text(own.out / "summary.md", summary)
    draw(results, own.out / "arena.png")
    return summary


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK")
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 10, 20, 50])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2, help="cells at a time; each works on one thread")
    parser.add_argument("--out", type=Path, default=Path("docs/results/arena"))
    arena_cell.add_settings(parser)
    try:
        print(run(parser.parse_args()))
    except (BadInput, Failed) as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
