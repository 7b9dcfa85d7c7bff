"""One cell of the arena: a task of Meta-World, a number of demonstrations and a training seed.

    python studies/arena_cell.py TASK COUNT SEED [--episodes 50] [--set KEY=VALUE]... [--runs DIR]

The spec is what ``ddco-pyro init`` writes for the demonstrations that the cell trains on, whatever the task; ``--set``
changes it for all. Keeps the fit and a JSON with held-out log-likelihoods, agreement with the expert's phases, and how
often each method succeeded from the same initial states. What this code has done with these settings is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from apart import Apart
from cells import digest, kept
from provenance import Record, record

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.fitting.run import fit
from ddco_pyro.spec import load_spec

OURS = "ddco"
LABELS = "phase"
HELD_OUT = 20
"""The first demonstrations of a file are held out, whatever the others are used for."""


@dataclass(frozen=True)
class Settings:
    """What all cells of a study share.

    :param demonstrations: recorded for each task, with those that are held out.
    :param noise: standard deviation of what is added to the expert's controls.
    :param episodes: played by each method.
    :param overrides: of the spec, each KEY=VALUE.
    :param runs: the folder of everything but the results.
    """

    demonstrations: int
    noise: float
    episodes: int
    overrides: tuple[str, ...]
    runs: Path

    def kept(self) -> dict[str, Any]:
        """What decides a result."""
        return {
            "demonstrations": self.demonstrations,
            "noise": self.noise,
            "episodes": self.episodes,
            "overrides": list(self.overrides),
        }

    def words(self) -> str:
        """The same as words of a command."""
        changes = "".join(f" --set '{one}'" for one in self.overrides)
        return f"--demonstrations {self.demonstrations} --noise {self.noise:g} --episodes {self.episodes}{changes}"


@dataclass(frozen=True)
class Cell:
    """A task, how many demonstrations to train on, and the seed that chooses them and trains."""

    task: str
    count: int
    seed: int

    def path(self, settings: Settings) -> Path:
        """Its JSON; other settings have other folders."""
        return settings.runs / "cells" / digest(settings.kept()) / f"{self.task}-{self.count:03d}-{self.seed}.json"

    def command(self, settings: Settings) -> str:
        """What runs it."""
        return f"python studies/arena_cell.py {self.task} {self.count} {self.seed} {settings.words()}"


def sawyer(settings: Settings) -> Apart:
    """Meta-World, in an environment of its own."""
    return Apart("arena_metaworld.py", "arena_requirements.txt", settings.runs)


def run(cell: Cell, settings: Settings, made_by: Record) -> dict[str, Any]:
    """A cell's provenance and results, as its JSON has them; nothing is done again.

    :param made_by: what was known of the code of this file when the work began.
    :raises Failed: Meta-World cannot be used, or the expert fails.
    """
    made_by = made_by | {"command": cell.command(settings)}
    named = {"task": cell.task, "count": cell.count, "seed": cell.seed} | settings.kept()
    return kept(cell.path(settings), named, made_by, lambda: _run(cell, settings, made_by))


def _run(cell: Cell, settings: Settings, made_by: Record) -> dict[str, Any]:
    begun, world = time.perf_counter(), sawyer(settings)
    source = world.collected(cell.task, number=settings.demonstrations, held_out=HELD_OUT, noise=settings.noise)
    folder = settings.runs / "fits" / made_by["code"][:12] / cell.path(settings).parent.name / cell.path(settings).stem
    fitted = fitted_cell(cell, source, settings.overrides, folder)
    trained = time.perf_counter()
    methods = {OURS: fitted} | fitted.baselines
    played = world.play(cell.task, methods, source, settings.episodes)
    ended = time.perf_counter()
    metrics = fitted.metrics
    return {
        "demonstrations_sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
        "expert": expert(source),
        "methods": {
            name: {
                "log_likelihood_per_step": one.metrics["log_likelihood_per_step"],
                "parameters": one.metrics["parameters"],
                "converged": one.metrics["training"]["converged"],
                "success": [episode["success"] for episode in played["episodes"][name]],
                "steps": [episode["steps"] for episode in played["episodes"][name]],
                "bridge_difference": played["differences"][name],
            }
            for name, one in methods.items()
        },
        "difference": {name: one["difference"] for name, one in metrics["comparison"].items()},
        "held_out": [row for row in metrics["demonstrations_by_likelihood"] if row["part"] == "valid"],
        "agreement": metrics["agreement"],
        "options": metrics["options"],
        "seconds": {"fit": trained - begun, "play": ended - trained, "all": ended - begun},
    }


def fitted_cell(cell: Cell, source: Path, overrides: tuple[str, ...], folder: Path) -> Fit:
    """A fit of the spec that ``ddco-pyro init`` writes for the training demonstrations, and of its baselines."""
    names, valid, unused = chosen(source, cell)
    facts = replace(inspect(source, exclude=[*valid, *unused]), excluded=())  # init is shown no others
    started = folder / "started.yaml"
    write_text(started, starting_spec(facts, source.resolve()))
    spec = load_spec(started, [*overrides, f"seed={cell.seed}"])
    demos = replace(
        Demonstrations.read(source, spec.observed, [LABELS]).select([*names, *valid]),
        masks={"train": tuple(names), "valid": tuple(valid)},
    )
    return fit(spec, demos, out=folder / "fit")


def chosen(source: Path, cell: Cell) -> tuple[list[str], list[str], list[str]]:
    """Names of the demonstrations that a cell trains on, of those that are held out from all cells, and of the others.

    A seed's demonstrations are among those that it has where there are more of them.

    :raises Failed: there are not so many.
    """
    with h5py.File(source) as file:
        train, valid = ([name.decode() for name in file[f"mask/{mask}"]] for mask in ("train", "valid"))
    if cell.count > len(train):
        raise Failed(f"{source}: has {len(train)} demonstrations to train on, {cell.count} are asked for")
    first = set(np.random.default_rng(cell.seed).permutation(len(train))[: cell.count])
    used = [name for place, name in enumerate(train) if place in first]
    return used, valid, [name for name in train if name not in used]


def expert(source: Path) -> dict[str, Any]:
    """How often the expert succeeded, and which part of the steps each of its phases has."""
    with h5py.File(source) as file:
        return dict(json.loads(str(file.attrs["expert"])))


def add_settings(parser: argparse.ArgumentParser) -> None:
    """The arguments that :func:`settings` reads."""
    parser.add_argument("--demonstrations", type=int, default=70)
    parser.add_argument("--noise", type=float, default=0.1)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--runs", type=Path, default=Path("runs/arena"))


def settings(own: argparse.Namespace) -> Settings:
    """What was said of all cells."""
    return Settings(own.demonstrations, own.noise, own.episodes, tuple(own.set), own.runs)


def main() -> None:
    """Run a cell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("count", type=int)
    parser.add_argument("seed", type=int)
    add_settings(parser)
    own = parser.parse_args()
    cell = Cell(own.task, own.count, own.seed)
    try:
        print(json.dumps(run(cell, settings(own), record(cell.command(settings(own)))), indent=1))
    except (BadInput, Failed) as error:
        raise SystemExit(str(error)) from None


if __name__ == "__main__":
    main()
