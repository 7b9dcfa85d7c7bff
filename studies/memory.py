"""Are options worth it for being several, or for lasting? A memoryless mixture in the cells of other studies.

    python studies/memory.py needle [--counts 20 100] [--seeds 10] [--check 2]
    python studies/memory.py pushing [--counts 40 80] [--seeds 10] [--check 10]
    python studies/memory.py arena [--counts 10 50] [--seeds 3] [--check 1] [--em 2]
        [--tasks pick-place-v3 ...]
    python studies/memory.py bins [--counts 60] [--seeds 3] [--check 0]
    python studies/memory.py planted [--seeds 5] [--check 2] [--tasks segments joint]
    python studies/memory.py page

A mixture is the hierarchy of that study's spec whose options end after every step (``termination: always``): the same
demonstrations, training seeds, starts and gradient steps. ``--check`` fits options of so many seeds again, to see
whether this code gives what the study's table has. ``--em`` fits them by expectation-maximisation, with its
ridges and without. Each cell is a few rows of ``docs/results/memory.csv`` as soon as it is done, and is not done again.
``page`` pairs mixtures by seed with the tables of those studies, and writes ``memory.md``, ``memory.png``, and the
table and figure of the README.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import arena_cell
import bin_picking
import needle as needle_study
import planted_levels
import pushing as pushing_study
import torch
from arena import TASKS
from cells import described, printed, some
from ddco_tasks.pushing import environment as pushing_task
from memory_results import (
    ACTING_BY,
    EM,
    FAR_END,
    FREE,
    MIXTURE,
    OPTIONS,
    Numbers,
    checks,
    comparisons,
    draw,
    everything,
    numbers,
    of_pages,
    page,
    short,
    shortest,
    with_table,
)
from table import RESULTS, ROOT, Row, add, read
from threadpoolctl import threadpool_limits

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.simulation.episodes import play
from ddco_pyro.spec import load_spec, with_overrides

METHODS: dict[str, dict[str, Any]] = {
    MIXTURE: {"hierarchy.levels.0.termination": "always"},
    OPTIONS: {},
    EM: {},
    FREE: {"training.optimizer.ridge": {"policy": 0.0, "gate": 0.0, "termination": 0.0}},
}
"""What each method changes in its study's spec."""
ADAM = {"name": "adam", "lr": 3e-3}
"""The optimiser of the arena's page, instead of the one that ``init`` writes, which is expectation-maximisation."""
ACTING = ("marginal", "sample", "most_likely")
EPISODES = {"needle": {20: 60, 100: 200}, "arena": 20, "bins": 20, "pushing": pushing_study.EPISODES}
"""Starts of each fit, as on the pages."""


@dataclass(frozen=True)
class Cell:
    """A method that is fitted and rolled out."""

    study: str
    task: str
    method: str
    demonstrations: int
    seed: int

    @property
    def name(self) -> str:
        """Of its folder."""
        return "-".join(map(str, astuple(self)))


class Measured(NamedTuple):
    """A number of a cell; ``acting`` is how options are chosen in rollouts, and empty where nothing acts."""

    acting: str
    measure: str
    value: float


def overridden(cell: Cell) -> dict[str, Any]:
    """What a cell changes in its study's spec: nothing is trained beside."""
    return {"compare_with": [], **METHODS[cell.method]}


def words(cell: Cell) -> list[str]:
    """The same as words of a command."""
    return [f"{key}={json.dumps(value)}" for key, value in overridden(cell).items()]


def needle(cell: Cell, runs: Path) -> list[Measured]:
    """As ``needle.py`` does."""
    changes = ["rollout.policies=[]", *words(cell)]
    spec = needle_study.spec_of("ddco", cell.seed, cell.demonstrations, changes)
    fitted = fit(spec, out=runs / "fits" / cell.name)
    rolled = roll_out(fitted, EPISODES["needle"].get(cell.demonstrations, 60), jobs=1)
    success = rolled.success_rates[fitted.name].rate
    nats = fitted.metrics.log_likelihood_per_step.valid
    return [Measured("", "nats", nats), Measured(spec.rollout.options, "success", success)]


def pushing(cell: Cell, runs: Path) -> list[Measured]:
    """As ``pushing_study.py`` does, by each way of acting."""
    spec = pushing_study.spec_of(pushing_study.PushingCell("DDCO MLP", 2, cell.demonstrations, cell.seed))
    spec = with_overrides(spec, overridden(cell))
    demos = pushing_study.pool(runs / "pushing", spec)
    demos = demos.select(demos.names[: cell.demonstrations])
    hierarchy = pushing_study.fit(spec, demos, runs / "fits" / cell.name)
    held_out = pushing_study.held_out(runs / "pushing", spec)
    found = [Measured("", "nats", pushing_study.per_step(Fit(spec, hierarchy), held_out))]
    first = pushing_study.EVALUATION + 1000 * cell.seed
    for acting in ACTING:
        rollout = spec.rollout.model_copy(update={"options": acting})
        episodes = play(
            pushing_task.task, Controller.from_spec(hierarchy, rollout), range(first, first + pushing_study.EPISODES)
        )
        goals = pushing_study.summary(episodes)["goals"]
        found.append(Measured(acting, "goals", sum(goals) / len(goals)))
    return found


def arena(cell: Cell, runs: Path) -> list[Measured]:
    """As ``arena_cell.py`` does."""
    settings = arena_cell.DEFAULTS
    source = arena_cell.recorded(cell.task, settings)
    own = arena_cell.ArenaCell(cell.task, cell.demonstrations, cell.seed)
    by_em = cell.method in (EM, FREE)
    changes = (*(() if by_em else (f"training.optimizer={json.dumps(ADAM)}",)), *words(cell))
    fitted = arena_cell.fitted_cell(own, source, changes, runs / "fits" / cell.name)
    played = arena_cell.sawyer(settings).play(cell.task, {cell.method: fitted}, source, EPISODES["arena"])
    successes = [episode["success"] for episode in played["episodes"][cell.method]]
    return [
        Measured("", "nats", fitted.metrics.log_likelihood_per_step.valid),
        Measured("", "NMI", fitted.metrics.model_dump()["agreement"]["valid"][0]["nmi"]),
        Measured(fitted.spec.rollout.options, "success", sum(successes) / len(successes)),
    ]


def bins(cell: Cell, runs: Path) -> list[Measured]:
    """As ``bin_picking.py`` does."""
    spec, folder = bin_picking.SPECS["bin_picking"], runs / "fits" / cell.name
    found = bin_picking.evaluated(spec, cell.seed, words(cell), cell.method, bin_picking.DEFAULTS, folder)
    own = found["methods"][cell.method]
    cleared = [one["cleared"] for one in own["bins"]]
    return [
        Measured("", "nats", own["log_likelihood_per_step"]["valid"]),
        Measured(load_spec(spec).rollout.options, "success", sum(cleared) / len(cleared)),
    ]


def planted(cell: Cell, runs: Path) -> list[Measured]:
    """As ``planted_levels.py`` does; its mixtures have no memory at any level."""
    row = planted_levels.one_fit(cell.task, cell.seed, lasting=cell.method == OPTIONS)
    levels = [Measured("", f"NMI, level {number}", value) for number, value in enumerate(row["found nmi"], 1)]
    return [Measured("", "nats", row["found"]), *levels]


STUDIES: dict[str, Callable[[Cell, Path], list[Measured]]] = {
    one.__name__: one for one in (needle, pushing, arena, bins, planted)
}


class Asked(NamedTuple):
    """Cells of a study.

    :param check: options of so many seeds are fitted again.
    :param em: options of so many seeds are fitted by expectation-maximisation, with ridges and without.
    """

    counts: tuple[int, ...]
    seeds: int
    check: int
    tasks: tuple[str, ...]
    em: int = 0


WHOLE = {
    "needle": Asked((20, 100), 10, 2, ("needle",)),
    "pushing": Asked((40, 80), 10, 10, ("pushing",)),
    "arena": Asked((10, 50), 3, 1, TASKS, em=2),
    "bins": Asked((60,), 3, 0, ("bins",)),
    "planted": Asked((planted_levels.DEMONSTRATIONS,), 5, 2, ("segments", "joint")),
}
"""What the page is about."""


def cells_of(study: str, asked: Asked) -> list[Cell]:
    """All counts and tasks of a seed before another seed, mixtures before the options that check them."""
    grid = itertools.product(range(asked.seeds), asked.counts, asked.tasks, METHODS)
    seeds = {MIXTURE: asked.seeds, OPTIONS: asked.check, EM: asked.em, FREE: asked.em}
    return [Cell(study, task, method, count, seed) for seed, count, task, method in grid if seed < seeds[method]]


def row_of(cell: Cell, one: Measured) -> Row:
    """A number in the table; its measure says how options were chosen."""
    acting = f"{ACTING_BY}{one.acting}" if one.acting else ""
    return Row(cell.study, cell.task, cell.method, cell.demonstrations, cell.seed, f"{one.measure}{acting}", one.value)


def done_in(path: Path) -> set[Cell]:
    """The cells of a table."""
    return {Cell(*row[:5]) for row in read(path)}


def work(cells: Sequence[Cell], runs: Path, out: Path) -> str:
    """Do the cells that the table has not, one by one; a line of how many there are."""
    done = done_in(out)
    todo = [cell for cell in cells if cell not in done]
    torch.set_num_threads(1)
    for cell in todo:
        begun, used = time.perf_counter(), sum(os.times()[:4])
        with threadpool_limits(1):
            measured = STUDIES[cell.study](cell, runs)
        add(out, [row_of(cell, one) for one in measured])
        shown = ", ".join(f"{one.measure} {one.acting} {one.value:.3f}" for one in measured)
        seconds = f"{time.perf_counter() - begun:.0f} s, {sum(os.times()[:4]) - used:.0f} s of them worked"
        print(f"{cell.name}: {shown} ({seconds})", flush=True)
    return f"{len(todo)} of {len(cells)} cells were not there"


def missing(done: set[Cell]) -> list[str]:
    """Of each study and number of demonstrations how many cells the table has not, and what does them."""
    lines = []
    for study, whole in WHOLE.items():
        for count in whole.counts:
            cells = cells_of(study, whole._replace(counts=(count,)))
            left = [cell for cell in cells if cell not in done]
            if left:
                asked_for = dict.fromkeys(one.method for one in cells)
                kinds = ", ".join(f"{sum(one.method == kind for one in left)} of {kind}" for kind in asked_for)
                lines.append(f"`{command(study, whole._replace(counts=(count,)))}`: {kinds}, of {len(cells)} cells")
    return lines


def command(study: str, asked: Asked) -> str:
    """What does these cells."""
    options = {"counts": asked.counts, "seeds": (asked.seeds,), "check": (asked.check,)}
    options |= {"em": (asked.em,)} if asked.em else {}
    options |= {} if asked.tasks == WHOLE[study].tasks else {"tasks": asked.tasks}
    said = "".join(f" --{name} {' '.join(map(str, values))}" for name, values in options.items())
    return f"python studies/memory.py {study}{said}"


def write_page(out: Path) -> str:
    """``memory.md`` and ``memory.png`` beside the table, README's table and its figure; the page."""
    found, again = compared(out)
    shown = page(found, again, missing(done_in(out)))
    write_text(out.with_suffix(".md"), shown)
    draw(everything(found), out.with_suffix(".png"))
    draw(shortest(found), ROOT / "docs" / "images" / "worth.png", columns=1)
    readme = ROOT / "README.md"
    write_text(readme, with_table(readme.read_text(encoding="utf-8"), short(found)))
    return shown


def compared(path: Path = RESULTS / "memory.csv") -> tuple[list[Numbers], list[Numbers]]:
    """What mixtures say beside the numbers of the other studies, and options that were fitted again beside theirs."""
    own = numbers(read(path))
    far = [one for one in own if one["task"] == FAR_END]  # of a bin that the tree has no more
    rows = [one for one in own if one["task"] != FAR_END or one["method"] == MIXTURE]
    pages = [*of_pages(), *(one for one in far if one["method"] != MIXTURE)]
    return comparisons(rows, pages), checks(rows, pages)


def main() -> None:
    """Do the cells of a study, or write the page."""
    parser = described(__doc__)
    parser.add_argument("study", choices=[*STUDIES, "page"])
    for name in ("counts", "seeds", "check", "em"):
        parser.add_argument(f"--{name}", type=int, nargs="+" if name == "counts" else None)
    parser.add_argument("--tasks", nargs="+")
    parser.add_argument("--runs", type=Path, default=Path("runs/memory"))
    parser.add_argument("--out", type=Path, default=RESULTS / "memory.csv")
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """What the command line asks for."""
    if own.study == "page":
        return write_page(own.out)
    said = {name: getattr(own, name) for name in Asked._fields if getattr(own, name) is not None}
    asked = WHOLE[own.study]._replace(
        **{name: tuple(one) if name in ("counts", "tasks") else one for name, one in said.items()}
    )
    return work(some(cells_of(own.study, asked)), own.runs, own.out)


if __name__ == "__main__":
    main()
