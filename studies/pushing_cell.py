"""One cell of the pushing studies: a method fitted to some demonstrations under one seed, and rolled out.

What a cell gives is kept in a small JSON of its own, so that a study can be stopped and resumed at any time.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from ddco_tasks.pushing import environment as pushing
from provenance import Record

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.simulation.episodes import Episode, play, run_episode
from ddco_pyro.simulation.task import Task
from ddco_pyro.spec import BaselineSpec, Spec, load_spec, network_spec, with_overrides
from ddco_pyro.training.data import dimensions
from ddco_pyro.training.networks import Dimensions, baseline_spec, build_hierarchy
from ddco_pyro.training.restarts import train_model

SETTINGS = Path(__file__).parent / "pushing_settings.json"  # written by the sweep
POOL = 80  # demonstrations of a seed; a cell takes the first ones
HELD_OUT = 40  # demonstrations, the same for every cell
LABELS = ("side", "phase", "skill")  # of the supervisor: goal left or right, approach or push, both
EPISODES = 20
UPDATES = 3000  # gradient steps of a fit, whatever the method and the number of demonstrations

# Seeds of the simulation. Those of development are used for nothing but the choice of hyper-parameters.
TRAINING, DEVELOPMENT, HELD_OUT_SEED = 100_000, 800_000, 900_000
EVALUATION, DEVELOPMENT_EPISODES = 2_000_000, 500_000

EQUAL = "flat MLP, equal parameters"

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "flat linear": ("pushing_flat_linear", {}),
    "flat MLP": ("pushing_flat_mlp", {}),
    EQUAL: ("pushing_mlp", {}),
    "DDCO linear": ("pushing_linear", {}),
    "DDCO MLP": ("pushing_mlp", {}),
    "hybrid MLP": ("pushing_mlp", {"hierarchy.meta_policy.emits": ["options", "control"]}),
}
"""Name of a method to its spec and what it changes there; the one of equal parameters is the flat policy beside it."""

VARIANTS: dict[str, tuple[dict[str, Any], int]] = {
    "base": ({}, UPDATES),
    "hand 0.2 rad/s": ({"demonstrations.supervisor": "scripted_noisy"}, UPDATES),
    "hand 0.4 rad/s": ({"demonstrations.supervisor": "scripted_noisy_0.4"}, UPDATES),
    "exact hand": ({"demonstrations.supervisor": "scripted"}, UPDATES),
    "planning supervisor": ({"demonstrations.supervisor": "supervisor_noisy_0.3"}, UPDATES),
    "absolute observations": ({"observations": ["joint_angles", "box_pose", "goal"]}, UPDATES),
    "std 0.5": ({"control.std": 0.5}, UPDATES),
    "10000 gradient steps": ({}, 10_000),
    "most likely options": ({"rollout.options": "most_likely"}, UPDATES),
    "sampled controls": ({"rollout.control": "sample"}, UPDATES),
}
"""What can be changed for every method alike: the change to the spec, and the number of gradient steps."""


@dataclass(frozen=True)
class Cell:
    """A method with k options (None: as its spec says, or flat), a number of demonstrations, and a training seed."""

    method: str
    options: int | None
    demonstrations: int
    seed: int
    variant: str = "base"

    @property
    def name(self) -> str:
        """A file name."""
        words = (self.method, f"k{self.options or 0}", f"n{self.demonstrations}", f"s{self.seed}")
        parts = words if self.variant == "base" else (*words, self.variant)
        return "-".join(parts).replace(" ", "-").replace(",", "").replace("/", "-").lower()

    @property
    def fit(self) -> str:
        """The name of the cell that has the same fit: variants of a rollout have that of the base."""
        changes, updates = VARIANTS[self.variant]
        same = updates == UPDATES and all(key.startswith("rollout.") for key in changes)
        return replace(self, variant="base").name if same else self.name


def spec_of(cell: Cell, settings: Mapping[str, Any] | None = None) -> Spec:
    """The spec of a cell, with the method's chosen ``settings`` (as the sweep found them, where none are given)."""
    file, overrides = METHODS[cell.method]
    variant, updates = VARIANTS[cell.variant]
    chosen = json.loads(SETTINGS.read_text())["chosen"][cell.method] if settings is None else settings
    changed = {**overrides, **chosen, **variant, "seed": cell.seed, "demonstrations.count": cell.demonstrations}
    if cell.options is not None:
        changed["hierarchy.levels.0.count"] = cell.options
    spec = with_overrides(load_spec(Path(__file__).parents[1] / "specs" / f"{file}.yaml"), changed)
    trained = cell.demonstrations - round_tune(cell.demonstrations, spec.training.tune_fraction)
    epochs = int(np.ceil(updates / np.ceil(trained / spec.training.batch_size)))
    spec = with_overrides(spec, {"training.epochs": epochs})
    return _flat_equal(spec) if cell.method == EQUAL else spec


def _flat_equal(spec: Spec) -> Spec:
    """A flat perceptron with as many parameters as the spec's hierarchy."""
    baseline = BaselineSpec(kind="flat_equal", policy=network_spec(hidden=[64]))
    return baseline_spec(spec, baseline, dimensions(spec))


def round_tune(count: int, fraction: float) -> int:
    """How many demonstrations are held out to stop by, about."""
    return max(1, round(count * fraction))


def demonstrations(folder: Path, supervisor: str, first: int, count: int) -> Demonstrations:
    """Demonstrations of one goal each from seeds ``first`` on; kept in a file."""
    path = folder / "demonstrations" / supervisor / f"{first}.hdf5"
    if not path.exists():
        episodes = [run_episode(pushing.single, supervisor, first + number) for number in range(count)]
        Demonstrations(tuple(one.record for one in episodes)).write(path)
    return Demonstrations.read(path, labels=LABELS)


def pool(folder: Path, spec: Spec, development: bool = False) -> Demonstrations:
    """All demonstrations of a spec's supervisor and training seed."""
    first = (DEVELOPMENT if development else TRAINING) + 1000 * spec.seed
    return demonstrations(folder, spec.demonstrations.supervisor, first, POOL)


def held_out(folder: Path, spec: Spec, development: bool = False) -> Demonstrations:
    """Demonstrations of a spec's supervisor that nothing is trained on; others for development."""
    return demonstrations(folder, spec.demonstrations.supervisor, HELD_OUT_SEED + 1000 * development, HELD_OUT)


def fit(spec: Spec, demos: Demonstrations, checkpoints: Path) -> tuple[Hierarchy, float]:
    """The fitted hierarchy, and the seconds that it took."""
    start = time.perf_counter()
    hierarchy = train_model(spec, Dimensions.of(demos), demos, checkpoints=checkpoints).hierarchy
    shutil.rmtree(checkpoints, ignore_errors=True)
    return hierarchy, time.perf_counter() - start


def per_step(fit: Fit, demos: Demonstrations) -> float:
    """Log-likelihood per step, nats, at the spec's σ."""
    return float(fit.log_likelihood(demos).sum() / sum(demos.lengths))


def fitted(cell: Cell, folder: Path, made_by: Record) -> Hierarchy:
    """The hierarchy of a cell, fitted unless it has been already."""
    spec = spec_of(cell)
    path = folder / "models" / f"{cell.fit}.safetensors"
    demos = pool(folder, spec)
    demos = demos.select(demos.names[: cell.demonstrations])
    if path.exists():
        hierarchy = build_hierarchy(spec, Dimensions.of(demos))
        hierarchy.load_state_dict(read_tensors(path)[0])
        return hierarchy.eval()
    hierarchy, seconds = fit(spec, demos, path.with_suffix(".checkpoints"))
    found = Fit(spec, hierarchy)
    likelihood = {"train": per_step(found, demos), "held_out": per_step(found, held_out(folder, spec))}
    numbers = {
        "parameters": sum(one.numel() for one in hierarchy.parameters()),
        "std": spec.control.std,
        "seconds": seconds,
        "made_by": made_by,
        "log_likelihood_per_step": likelihood,
    }
    write_text(folder / "fits" / f"{cell.fit}.json", json.dumps(numbers, indent=1) + "\n")
    write_tensors(path, hierarchy.state_dict(), {})
    return hierarchy


def fit_made_by(cell: Cell, folder: Path) -> Record | None:
    """What fitted a cell; None for a fit from before that was recorded."""
    found: Record | None = json.loads((folder / "fits" / f"{cell.fit}.json").read_text()).get("made_by")
    return found


def run(cell: Cell, folder: Path, made_by: Record, limited: bool = False) -> None:
    """Fit and roll out a cell, and keep what came of it; nothing where it has been kept already.

    :param made_by: the record of the study that does so.
    :param limited: at most 250 steps for each goal.
    """
    torch.set_num_threads(1)
    path = folder / ("limited" if limited else "rollouts") / f"{cell.name}.json"
    if path.exists():
        return
    hierarchy = fitted(cell, folder, made_by)
    first = EVALUATION + 1000 * cell.seed
    task: Task = pushing.limited if limited else pushing.task
    start = time.perf_counter()
    episodes = play(task, Controller.from_spec(hierarchy, spec_of(cell).rollout), range(first, first + EPISODES))
    found = {**summary(episodes), "seconds": time.perf_counter() - start, "made_by": made_by}
    write_text(path, json.dumps(found, indent=1) + "\n")


def summary(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Each episode's counts; mean steps between changes of option; part of the steps that the meta-policy acts."""
    counts = {name: [one.outcome[name] for one in episodes] for name in ("goals", "topples", "lost")}
    choices = [one.choices for one in episodes]
    if choices[0].shape[1] == 0:
        return {**counts, "dwell": None, "own_control": None}
    changes = sum(int((one[1:] != one[:-1]).any(axis=1).sum()) for one in choices)
    steps = sum(len(one) for one in choices)
    own = sum(int((one[:, -1] == 0).sum()) for one in choices)
    return {**counts, "dwell": steps / (changes + len(choices)), "own_control": own / steps}
