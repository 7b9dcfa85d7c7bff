"""Segments and success on tasks of Meta-World with several phases, over numbers of demonstrations and training seeds.

    python studies/arena.py [--tasks pick-place-v3 ...] [--counts 5 10 20 50] [--seeds 5] [--episodes 50] [--jobs 2]
        [--set KEY=VALUE]... [--demonstrations 70] [--noise 0.1] [--out DIR] [--runs DIR]

Records the demonstrations of Meta-World's scripted experts in an environment of its own (``RUNS/venv``), fits what
``ddco-pyro init`` writes for them, and lets ddco, flat and flat_equal act. A cell (task, number, seed) that was done
with these settings is not done again. Adds its numbers to ``docs/results/arena.csv``.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import study
from apart import HELD_OUT, Apart, expert
from study import Cell, Row, Settings, described

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Scores
from ddco_pyro.segmenting.baselines import BASELINES, segment
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import parts

TASKS = tuple(
    f"{name}-v3"
    for name in (
        "pick-place", "assembly", "shelf-place", "stick-pull", "hammer", "disassemble", "basketball", "hand-insert",
        "sweep-into",
    )
)  # fmt: skip
OURS = "ddco"
LABELS = "phase"
MEASURES = ("nmi", "ari", "accuracy", "iou", "f1_10", "f1_25", "f1_50", "edit", "boundary_f1_1", "boundary_f1_3",
            "boundary_f1_5")  # fmt: skip

DEFAULTS = Settings({"demonstrations": 70, "noise": 0.1, "episodes": 50}, Path("runs/arena"))
"""Recorded for each task, with those that are held out; the standard deviation of what is added to the expert's
controls; and what each method plays."""


@dataclass(frozen=True)
class ArenaCell(Cell):
    """A task, how many demonstrations to train on, and the seed that chooses them and trains."""

    task: str
    count: int
    seed: int

    def __post_init__(self) -> None:
        """:raises BadInput: there is nothing to train on."""
        if self.count < 1:
            raise BadInput(f"{self.count} demonstrations to train on: it has to be 1 or more")

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.task}-{self.count:03d}-{self.seed}"

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, play, and say how often each method succeeded."""
        begun, world, own = time.perf_counter(), sawyer(settings), settings.values
        source = recorded(self.task, settings)
        fitted = fitted_cell(self, source, settings.overrides, folder)
        trained = time.perf_counter()
        methods = {OURS: fitted} | fitted.baselines
        played = world.play(self.task, methods, source, int(own["episodes"]))
        ended = time.perf_counter()
        metrics = fitted.metrics.model_dump()
        return {
            "demonstrations_sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
            "expert": expert(source),
            "methods": {
                name: {
                    "log_likelihood_per_step": one.metrics.log_likelihood_per_step.model_dump(),
                    "parameters": one.metrics.parameters,
                    "converged": one.metrics.training.converged,
                    "success": [episode["success"] for episode in played["episodes"][name]],
                    "steps": [episode["steps"] for episode in played["episodes"][name]],
                    "bridge_difference": played["differences"][name],
                }
                for name, one in methods.items()
            },
            "difference": {name: one["difference"] for name, one in metrics["comparison"].items()},
            "held_out": [row for row in metrics["demonstrations_by_likelihood"] if row["part"] == "valid"],
            "agreement": metrics["agreement"],
            "segments": scored(fitted, LABELS),
            "options": metrics["options"],
            "seconds": {"fit": trained - begun, "play": ended - trained, "all": ended - begun},
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Success and likelihood of each method, and agreement of every segmentation with the phases."""
        for method, one in results["methods"].items():
            named = "arena", self.task, method, self.count, self.seed
            yield Row(*named, "success", float(np.mean(one["success"])))
            yield Row(*named, "nats", one["log_likelihood_per_step"]["valid"])
        yield Row("arena", self.task, OURS, self.count, self.seed, "NMI", results["segments"][OURS]["nmi"])
        for method, scores in results["segments"].items():
            for measure in ("nmi", "accuracy", "f1_50"):
                name = "NMI" if measure == "nmi" else measure
                yield Row("segments", self.task, method, self.count, self.seed, name, scores[measure])


def sawyer(settings: Settings) -> Apart:
    """Meta-World, in an environment of its own."""
    return Apart("arena_metaworld.py", "arena_requirements.txt", settings.runs)


def recorded(task: str, settings: Settings) -> Path:
    """The demonstrations of a task, which all cells of these settings share.

    :raises BadInput: there is no such task.
    :raises Failed: the simulator cannot be used, or its expert fails.
    """
    own = settings.values
    return sawyer(settings).collected(task, number=own["demonstrations"], held_out=HELD_OUT, noise=own["noise"])


def fitted_cell(cell: ArenaCell, source: Path, overrides: tuple[str, ...], folder: Path) -> Fit:
    """A fit of the spec that ``ddco-pyro init`` writes for the training demonstrations, and of its baselines."""
    names, valid, unused = chosen(source, cell)
    facts = replace(inspect(source, exclude=[*valid, *unused]), excluded=(), masks={})  # init is shown no others
    started = folder / "started.yaml"
    write_text(started, starting_spec(facts, source.resolve()).text)
    spec = load_spec(started, [*overrides, f"seed={cell.seed}"])
    demos = replace(
        Demonstrations.read(source, spec.observed, [LABELS]).select([*names, *valid]),
        masks={"train": tuple(names), "valid": tuple(valid)},
    )
    return fit(spec, demos, out=folder / "fit")


def chosen(source: Path, cell: ArenaCell) -> tuple[list[str], list[str], list[str]]:
    """Names of the demonstrations that a cell trains on, of those that are held out from all cells, and of the others.

    A seed's demonstrations are among those that it has where there are more of them.

    :raises BadInput: there are not so many.
    """
    with h5py.File(source) as file:
        train, valid = ([name.decode() for name in file[f"mask/{mask}"]] for mask in ("train", "valid"))
    if cell.count > len(train):
        raise BadInput(f"{source}: has {len(train)} demonstrations to train on, {cell.count} are asked for")
    first = set(np.random.default_rng(cell.seed).permutation(len(train))[: cell.count])
    used = [name for place, name in enumerate(train) if place in first]
    return used, valid, [name for name in train if name not in used]


def cells(own: argparse.Namespace) -> list[ArenaCell]:
    """All tasks with few demonstrations before any with more; all of a seed before another."""
    product = itertools.product(range(own.seeds), own.counts, own.tasks)
    return [ArenaCell(task, count, seed) for seed, count, task in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK")
    parser.add_argument("--counts", type=int, nargs="+", default=[5, 10, 20, 50])
    parser.add_argument("--seeds", type=int, default=5)
    study.main("arena", parser, DEFAULTS, cells, lambda settings: sawyer(settings).made())


def scored(fitted: Fit, labels: str) -> dict[str, dict[str, float]]:
    """Measures on held-out demonstrations of the lowest level's options and of every baseline with as many kinds."""
    train, valid = parts(fitted.spec, fitted.demonstrations).values()
    hierarchy, truth = fitted.spec.hierarchy, [demo.labels[labels] for demo in valid]
    assert hierarchy is not None  # it is what init writes
    count, observations = hierarchy.levels[0].count, fitted.spec.observations
    segments = {OURS: fitted.segment(valid)[0]}
    segments |= {name: segment(name, train, valid, count, fitted.spec.seed, observations) for name in BASELINES}
    return {name: flat(agreement(own, truth)) for name, own in segments.items()}


def flat(measures: Scores | None) -> dict[str, float]:
    """Each measure as a number, options matched globally where they are."""
    assert measures is not None  # every step of the arena has a phase
    both = dict(measures) | dict(measures.matched_globally)
    return {name: float(both[name]) for name in MEASURES}


if __name__ == "__main__":
    main()
