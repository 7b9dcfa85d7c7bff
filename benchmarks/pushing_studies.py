"""The studies of planar pushing (paper §5.1): each fits and rolls out many small cells, and can be stopped and resumed.

    python benchmarks/pushing_studies.py sweep
    python benchmarks/pushing_studies.py sample_complexity [--seeds 5] [--limited] [--jobs 2] [--runs DIR] [--out DIR]
        [--demonstrations 20 40 80] [--options 1 2 4 8] [--methods "flat MLP" "DDCO MLP"]
    python benchmarks/pushing_studies.py number_of_options
    python benchmarks/pushing_studies.py augmentation

``sweep`` chooses every method's learning rate by held-out likelihood on demonstrations of development seeds, and writes
``pushing_settings.json`` beside this file. A study writes NAME.csv, NAME.png and NAME.md from all cells that are done;
it goes through the grid one seed after the other. ``--limited`` adds rollouts with at most 250 steps for each goal.
``--demonstrations``, ``--options`` and ``--methods`` run a part of the grid; what is written has every cell of the grid
that is done, and says of how many seeds. ``--summarize`` runs nothing.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from pushing_cell import METHODS, SETTINGS, Cell, fit, held_out, per_step, pool, run, spec_of
from pushing_results import write

from ddco_pyro.files import write_text

COUNTS = (5, 10, 20, 40, 80)
OPTIONS = (1, 2, 3, 4, 5, 6, 7, 8)
SWEPT = {"training.optimizer.lr": (2e-3, 5e-3, 1e-2)}
SWEPT_DEMONSTRATIONS, SWEPT_SEEDS = 40, (0,)
OWN_OPTIONS = {"DDCO linear": 5, "DDCO MLP": 2}  # what the specs say


def sample_complexity(seed: int) -> list[Cell]:
    """Every method with more and more demonstrations."""
    methods = [name for name in METHODS if not name.startswith("hybrid")]
    return [Cell(name, OWN_OPTIONS.get(name), count, seed) for count, name in itertools.product(COUNTS, methods)]


def number_of_options(seed: int) -> list[Cell]:
    """Both kinds of options, k = 1 to 8, 40 demonstrations."""
    return [Cell(name, k, 40, seed) for name, k in itertools.product(("DDCO MLP", "DDCO linear"), OPTIONS)]


def augmentation(seed: int) -> list[Cell]:
    """Options only and hybrid, 40 demonstrations."""
    return [Cell(name, k, 40, seed) for name, k in itertools.product(("DDCO MLP", "hybrid MLP"), OPTIONS)]


STUDIES: dict[str, Callable[[int], list[Cell]]] = {
    "sample_complexity": sample_complexity,
    "number_of_options": number_of_options,
    "augmentation": augmentation,
}


def try_setting(name: str, values: tuple[float, ...], seed: int, folder: Path) -> dict[str, Any]:
    """Held-out likelihood of a method with some hyper-parameters on the demonstrations of a development seed."""
    torch.set_num_threads(1)
    settings = dict(zip(SWEPT, values, strict=True))
    label = "-".join(str(value) for value in values)
    cell = Cell(name, OWN_OPTIONS.get(name), SWEPT_DEMONSTRATIONS, seed)
    path = folder / "sweep" / f"{cell.name}-{label}.json"
    if path.exists():
        found: dict[str, Any] = json.loads(path.read_text())
        return found
    demos = pool(folder, seed, development=True)
    demos = demos.select(demos.names[:SWEPT_DEMONSTRATIONS])
    hierarchy, seconds = fit(spec_of(cell, settings), demos, path.with_suffix(".checkpoint"))
    value = per_step(hierarchy, held_out(folder, development=True))
    found = {"method": name, "settings": settings, "seed": seed, "held_out": value, "seconds": seconds}
    write_text(path, json.dumps(found, indent=1) + "\n")
    return found


def sweep(folder: Path, jobs: int) -> None:
    """Choose every method's hyper-parameters from the same grid."""
    grid = list(itertools.product(METHODS, itertools.product(*SWEPT.values()), SWEPT_SEEDS))
    rows = Parallel(n_jobs=jobs)(delayed(try_setting)(*one, folder) for one in grid)
    chosen: dict[str, dict[str, Any]] = {}
    for name in METHODS:
        held: dict[tuple[float, ...], list[float]] = {}
        for row in rows:
            if row["method"] == name:
                held.setdefault(tuple(row["settings"].values()), []).append(row["held_out"])
        chosen[name] = dict(zip(SWEPT, max(held, key=lambda values: np.mean(held[values])), strict=True))
    command = "python benchmarks/pushing_studies.py sweep"
    write_text(SETTINGS, json.dumps({"command": command, "chosen": chosen, "tried": rows}, indent=1) + "\n")


def prepare(seeds: Sequence[int], folder: Path) -> None:
    """Collect all demonstrations first, so that no two cells collect the same."""
    held_out(folder)
    for seed in seeds:
        pool(folder, seed)


def main() -> None:
    """Run one study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=["sweep", *STUDIES])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--demonstrations", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--options", type=int, nargs="+", default=OPTIONS)
    parser.add_argument("--methods", nargs="+", default=tuple(METHODS), choices=METHODS)
    parser.add_argument("--limited", action="store_true")
    parser.add_argument("--summarize", action="store_true")
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--runs", type=Path, default=Path("runs/pushing-studies"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/pushing"))
    arguments = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    if arguments.study == "sweep":
        held_out(arguments.runs, development=True)
        for seed in SWEPT_SEEDS:
            pool(arguments.runs, seed, development=True)
        sweep(arguments.runs, arguments.jobs)
        return
    seeds = range(arguments.seeds)
    cells = [cell for seed in seeds for cell in STUDIES[arguments.study](seed)]
    if not arguments.summarize:
        prepare(seeds, arguments.runs)
        work(cells_of(arguments, cells), arguments)
    write(arguments.study, cells, arguments.runs, arguments.out, command_of(arguments))


def command_of(arguments: argparse.Namespace) -> str:
    """The command that runs what was asked for."""
    parts = ["python", "benchmarks/pushing_studies.py", arguments.study, "--seeds", str(arguments.seeds)]
    for name, everything in (("demonstrations", COUNTS), ("options", OPTIONS), ("methods", tuple(METHODS))):
        asked = tuple(getattr(arguments, name))
        parts += [f"--{name}", *map(str, asked)] if asked != everything else []
    return shlex.join(parts + ["--limited"] * arguments.limited)


def cells_of(arguments: argparse.Namespace, cells: Sequence[Cell]) -> list[Cell]:
    """The cells of the grid that were asked for."""
    return [
        cell
        for cell in cells
        if cell.method in arguments.methods
        and cell.demonstrations in arguments.demonstrations
        and (arguments.study == "sample_complexity" or cell.options in arguments.options)
    ]


def work(cells: Sequence[Cell], arguments: argparse.Namespace) -> None:
    """Fit and roll out the cells, in parallel."""
    todo = [(cell, limited) for limited in (False, *[True] * arguments.limited) for cell in cells]
    workers = Parallel(n_jobs=arguments.jobs, return_as="generator_unordered", pre_dispatch="n_jobs")
    for done, _ in enumerate(workers(delayed(run)(cell, arguments.runs, limited) for cell, limited in todo), 1):
        print(f"{arguments.study}: {done} of {len(todo)}", flush=True)


if __name__ == "__main__":
    main()
