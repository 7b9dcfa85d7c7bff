"""The studies of planar pushing (paper §5.1): each fits and rolls out many small cells, and can be stopped and resumed
(but for the sweep of settings before them).

    python studies/pushing_studies.py sweep [--methods ...]
    python studies/pushing_studies.py sample_complexity [--seeds 5] [--limited] [--jobs 2] [--runs DIR] [--out DIR]
        [--demonstrations 20 40 80] [--options 1 2 4 8] [--methods "flat MLP" "DDCO MLP"]
    python studies/pushing_studies.py number_of_options
    python studies/pushing_studies.py augmentation
    python studies/pushing_studies.py variants [--variants "exact hand" "std 0.5"]

``sweep`` chooses every method's learning rate, its schedule and weight decay by held-out likelihood on demonstrations
of development seeds, then its execution (mean or sampled controls; sampled, most likely or marginal options) by goals
in development episodes, and writes ``pushing_settings.json`` beside this file; fits that are done are kept.
``variants`` changes one thing at a time for every method alike. A study writes NAME.csv, NAME.png and NAME.md from all
cells that are done; it goes through the grid one seed after the other. ``--limited`` adds rollouts with at most 250
steps for each goal. ``--demonstrations``, ``--options``, ``--methods`` and ``--variants`` run a part of the grid; what
is written has every cell of the grid that is done, and says of how many seeds. ``--summarize`` runs nothing.
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
from cells import described, printed, some
from ddco_tasks.pushing import environment as pushing
from joblib import Parallel, delayed
from provenance import Record, record
from pushing_cell import (
    DEVELOPMENT_EPISODES,
    METHODS,
    SETTINGS,
    VARIANTS,
    Cell,
    fit,
    held_out,
    per_step,
    pool,
    run,
    spec_of,
    summary,
)
from pushing_results import grouped, write

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.files import write_text
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.simulation.episodes import play
from ddco_pyro.spec import Spec
from ddco_pyro.training.networks import Dimensions, build_hierarchy

COUNTS = (5, 20, 40, 80)
OPTIONS = (1, 2, 3, 4, 5, 6, 7, 8)
RATES, DECAYS, SCHEDULES = (5e-3, 1e-2), (0.0, 1e-3), ("constant", "cosine")
"""A weight decay of 1e-2 was less likely than none for every method, with both rates."""
OPTIMIZERS = tuple(
    {"training.optimizer.lr": rate, "training.optimizer.weight_decay": decay, "training.optimizer.schedule": schedule}
    for rate, decay, schedule in itertools.product(RATES, DECAYS, SCHEDULES)
)
EXECUTIONS = (*itertools.product(("mean",), ("sample", "most_likely", "marginal")), ("sample", "sample"))
"""Of the control, and of options; sampled controls ruin every policy, whatever the options."""
SWEPT_DEMONSTRATIONS, SWEPT_SEEDS, SWEPT_EPISODES = 40, (0, 1), 12
OWN_OPTIONS = {"DDCO linear": 5, "DDCO MLP": 2, "hybrid MLP": 2}  # what the specs say


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


def variants(seed: int) -> list[Cell]:
    """One thing changed at a time, for the methods with perceptrons."""
    methods = ("flat MLP", "flat MLP, equal parameters", "DDCO MLP")
    grid = itertools.product(VARIANTS, (40, 80), methods)
    cells = [Cell(name, OWN_OPTIONS.get(name), count, seed, variant) for variant, count, name in grid]
    return [one for one in cells if one.options or one.variant != "most likely options"]


STUDIES: dict[str, Callable[[int], list[Cell]]] = {
    "sample_complexity": sample_complexity,
    "number_of_options": number_of_options,
    "augmentation": augmentation,
    "variants": variants,
}


def candidate(name: str, number: int, seed: int, folder: Path) -> tuple[Cell, Spec, Hierarchy]:
    """A method fitted with an optimiser of the grid to the demonstrations of a development seed."""
    torch.set_num_threads(1)
    cell = Cell(name, OWN_OPTIONS.get(name), SWEPT_DEMONSTRATIONS, seed)
    spec = spec_of(cell, OPTIMIZERS[number])
    demos = pool(folder, spec, development=True)
    demos = demos.select(demos.names[:SWEPT_DEMONSTRATIONS])
    path = folder / "sweep" / f"{cell.name}-{number}.safetensors"
    if path.exists():
        hierarchy = build_hierarchy(spec, Dimensions.of(demos))
        hierarchy.load_state_dict(read_tensors(path)[0])
        return cell, spec, hierarchy.eval()
    hierarchy, _ = fit(spec, demos, path.with_suffix(".checkpoints"))
    write_tensors(path, hierarchy.state_dict(), {})
    return cell, spec, hierarchy


def try_optimizer(name: str, number: int, seed: int, folder: Path) -> dict[str, Any]:
    """Held-out likelihood with an optimiser of the grid."""
    _, spec, hierarchy = candidate(name, number, seed, folder)
    value = per_step(Fit(spec, hierarchy), held_out(folder, spec, development=True))
    return {"method": name, "number": number, **OPTIMIZERS[number], "seed": seed, "held_out": value}


def try_executions(name: str, number: int, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Goals in development episodes with every execution; a flat policy has no options to be sampled."""
    cell, spec, hierarchy = candidate(name, number, seed, folder)
    first, found = DEVELOPMENT_EPISODES + 1000 * seed, []
    for control, options in EXECUTIONS if cell.options else EXECUTIONS[::3]:
        rollout = spec.rollout.model_copy(update={"control": control, "options": options})
        episodes = play(pushing.task, Controller.from_spec(hierarchy, rollout), range(first, first + SWEPT_EPISODES))
        goals = float(np.mean(summary(episodes)["goals"]))
        found.append({"method": name, "control": control, "options": options, "seed": seed, "goals": goals})
    return found


def sweep(folder: Path, jobs: int, names: Sequence[str]) -> str:
    """Choose every method's optimiser and execution from the same grids; what was chosen for other methods stays."""
    for seed in SWEPT_SEEDS:
        spec = spec_of(Cell("flat MLP", None, SWEPT_DEMONSTRATIONS, seed), {})
        pool(folder, spec, development=True)
        held_out(folder, spec, development=True)
    grid = list(itertools.product(names, range(len(OPTIMIZERS)), SWEPT_SEEDS))
    fits = Parallel(n_jobs=jobs)(delayed(try_optimizer)(*one, folder) for one in grid)
    numbers = {name: best(fits, name, "held_out", "number")[0] for name in names}
    pairs = [(name, number, seed, folder) for name, number in numbers.items() for seed in SWEPT_SEEDS]
    executions = list(itertools.chain(*Parallel(n_jobs=jobs)(delayed(try_executions)(*one) for one in pairs)))
    before = json.loads(SETTINGS.read_text())
    chosen = before["chosen"] | {name: dict(OPTIMIZERS[number]) for name, number in numbers.items()}
    for name in names:
        control, options = best(executions, name, "goals", "control", "options")
        chosen[name] |= {"rollout.control": control, "rollout.options": options}
    rows = {"fits": fits, "executions": executions}
    others = {key: [row for row in before.get(key, ()) if row["method"] not in names] for key in rows}
    command = shlex.join(["python", "studies/pushing_studies.py", "sweep", "--methods", *names])
    found = {"command": command, "chosen": chosen, **{key: others[key] + rows[key] for key in rows}}
    write_text(SETTINGS, json.dumps(found, indent=1) + "\n")
    return str(SETTINGS)


def best(rows: Sequence[dict[str, Any]], name: str, measure: str, *keys: str) -> tuple[Any, ...]:
    """The values of ``keys`` with the highest mean of a measure over seeds, for a method."""
    means = {
        values: np.mean([row[measure] for row in own])
        for values, own in grouped([row for row in rows if row["method"] == name], *keys).items()
    }
    return max(means, key=means.__getitem__)


def prepare(cells: Sequence[Cell], folder: Path) -> None:
    """Collect all demonstrations first, so that no two cells collect the same."""
    specs = [spec_of(cell) for cell in cells]
    for spec in {(one.demonstrations.supervisor, one.seed): one for one in specs}.values():
        held_out(folder, spec)
        pool(folder, spec)


def main() -> None:
    """Run one study."""
    parser = described(__doc__)
    parser.add_argument("study", choices=["sweep", *STUDIES])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--demonstrations", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--options", type=int, nargs="+", default=OPTIONS)
    parser.add_argument("--methods", nargs="+", default=tuple(METHODS), choices=METHODS)
    parser.add_argument("--variants", nargs="+", default=tuple(VARIANTS), choices=VARIANTS)
    parser.add_argument("--limited", action="store_true")
    parser.add_argument("--summarize", action="store_true")
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--runs", type=Path, default=Path("runs/pushing-studies"))
    parser.add_argument("--out", type=Path, default=Path("docs/results/pushing"))
    os.environ["OMP_NUM_THREADS"] = "1"
    printed(lambda: study(parser.parse_args()))


def study(arguments: argparse.Namespace) -> str:
    """Do what is asked for, and write what there is; the page, or the file of what was chosen."""
    if arguments.study == "sweep":
        return sweep(arguments.runs, arguments.jobs, arguments.methods)
    command = command_of(arguments)
    made_by = record(command)
    cells = some([cell for seed in range(arguments.seeds) for cell in STUDIES[arguments.study](seed)])
    if not arguments.summarize:
        asked = some(cells_of(arguments, cells))
        prepare(asked, arguments.runs)
        work(asked, arguments, made_by)
    return write(arguments.study, cells, arguments.runs, arguments.out, command)


def command_of(arguments: argparse.Namespace) -> str:
    """The command that runs what was asked for."""
    parts = ["python", "studies/pushing_studies.py", arguments.study, "--seeds", str(arguments.seeds)]
    whole = {"demonstrations": COUNTS, "options": OPTIONS, "methods": tuple(METHODS), "variants": tuple(VARIANTS)}
    for name, everything in whole.items():
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
        and cell.variant in arguments.variants
        and (arguments.study in ("sample_complexity", "variants") or cell.options in arguments.options)
    ]


def work(cells: Sequence[Cell], arguments: argparse.Namespace, made_by: Record) -> None:
    """Fit and roll out the cells, in parallel."""
    todo = [(cell, limited) for limited in (False, *[True] * arguments.limited) for cell in cells]
    workers = Parallel(n_jobs=arguments.jobs, return_as="generator_unordered", pre_dispatch="n_jobs")
    for done, _ in enumerate(
        workers(delayed(run)(cell, arguments.runs, made_by, limited) for cell, limited in todo), 1
    ):
        print(f"{arguments.study}: {done} of {len(todo)}", flush=True)


if __name__ == "__main__":
    main()
