"""Planar pushing (paper §5.1): each method with more and more demonstrations, options, and one thing changed.

    python studies/pushing.py sample_complexity [--seeds 5] [--demonstrations 40 80] [--methods "flat MLP" "DDCO MLP"]
    python studies/pushing.py number_of_options|augmentation [--options 1 2 4 8]
    python studies/pushing.py variants [--variants "exact hand" "std 0.5"]
    python studies/pushing.py acting --first 10 --seeds 20 --demonstrations 40 80 --out docs/results/memory.csv

``acting`` plays options and a mixture by each way of choosing among them. ``--demonstrations``, ``--options``,
``--methods`` and ``--variants`` do a part of a study. ``pushing_settings.json`` has what a sweep over demonstrations
and episodes of development seeds chose for each method: learning rate, weight decay, and how it acts. The mixture has
the settings of the options. A cell that was done is not done again. Adds its numbers to ``docs/results/pushing.csv``.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import study
from ddco_tasks.pushing import environment as pushing
from study import Cell, Row, Settings, described

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.simulation.episodes import Episode, play, run_episode
from ddco_pyro.spec import BaselineSpec, Spec, load_spec, network_spec, with_overrides
from ddco_pyro.training.data import dimensions
from ddco_pyro.training.networks import Dimensions, baseline_spec
from ddco_pyro.training.restarts import train_model

SETTINGS = Path(__file__).parent / "pushing_settings.json"  # what the sweep chose
POOL = 80  # demonstrations of a seed; a cell takes the first ones
HELD_OUT = 40  # demonstrations, the same for every cell
LABELS = ("side", "phase", "skill")  # of the supervisor: goal left or right, approach or push, both
EPISODES = 20
UPDATES = 3000  # gradient steps of a fit, whatever the method and the number of demonstrations

TRAINING, HELD_OUT_SEED, EVALUATION = 100_000, 900_000, 2_000_000
"""Seeds of the simulation; the sweep's demonstrations began at 800 000, and its episodes at 500 000."""
COUNTS, OPTIONS = (5, 20, 40, 80), (1, 2, 3, 4, 5, 6, 7, 8)
OWN_OPTIONS = {"DDCO linear": 5, "DDCO MLP": 2, "hybrid MLP": 2, "mixture MLP": 2}  # what the specs say
ACTING = {  # the most likely option of a mixture is its marginal one
    "mixture MLP": ("mixture", ("marginal", "sample")),
    "DDCO MLP": ("options", ("marginal", "sample", "most_likely")),
}
"""Name of a method to its name in the table of memory, and the ways in which it chooses options."""
DEFAULTS = Settings({}, Path("runs/pushing"))

EQUAL = "flat MLP, equal parameters"

METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "flat linear": ("pushing_flat_linear", {}),
    "flat MLP": ("pushing_flat_mlp", {}),
    EQUAL: ("pushing_mlp", {}),
    "DDCO linear": ("pushing_linear", {}),
    "DDCO MLP": ("pushing_mlp", {}),
    "hybrid MLP": ("pushing_mlp", {"hierarchy.meta_policy.emits": ["options", "control"]}),
    "mixture MLP": ("pushing_mlp", {"hierarchy.levels.0.termination": "always", "compare_with": []}),
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
class PushingCell(Cell):
    """A method with k options (0: flat), a number of demonstrations, a training seed, and what is changed."""

    method: str
    options: int
    demonstrations: int
    seed: int
    variant: str = "base"
    study: str = "sample_complexity"

    @property
    def name(self) -> str:
        """A file name; cells of two studies are one."""
        words = (self.method, f"k{self.options}", f"n{self.demonstrations}", f"s{self.seed}")
        parts = words if self.variant == "base" else (*words, self.variant)
        return "-".join(parts).replace(" ", "-").replace(",", "").replace("/", "-").lower()

    def depends(self, settings: Settings) -> dict[str, Any]:
        """As every cell, whichever study it is of."""
        return super().depends(settings) | {"study": ""}

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, and play without a limit and with 250 steps for each goal."""
        spec = spec_of(self)
        demos = pool(settings.runs, spec)
        hierarchy = fit(spec, demos.select(demos.names[: self.demonstrations]), folder)
        first = EVALUATION + 1000 * self.seed
        seeds, controller = range(first, first + EPISODES), Controller.from_spec(hierarchy, spec.rollout)
        tasks = {"goals": pushing.task, "limited": pushing.limited}
        return {
            "nats": per_step(Fit(spec, hierarchy), held_out(settings.runs, spec)),
            "played": {name: summary(play(task, controller, seeds)) for name, task in tasks.items()},
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Means over episodes, and the held-out likelihood."""
        method = self.method + (f", k = {self.options}" if self.options else "")
        named = self.study, self.variant, method, self.demonstrations, self.seed
        own, limited = results["played"]["goals"], results["played"]["limited"]
        yield Row(*named, "goals", float(np.mean(own["goals"])))
        yield Row(*named, "goals, 250 steps each", float(np.mean(limited["goals"])))
        yield Row(*named, "topples", float(np.mean(own["topples"])))
        yield Row(*named, "nats", results["nats"])
        if own["dwell"] is not None:
            yield Row(*named, "steps an option lasts", own["dwell"])
            yield Row(*named, "steps under own control", own["own_control"])


class ActingCell(PushingCell):
    """A method that acts by each way of choosing options, without a limit."""

    @property
    def name(self) -> str:
        """A file name."""
        return f"acting-{super().name}"

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, and play from the same starts by each way."""
        spec = spec_of(self)
        demos = pool(settings.runs, spec)
        hierarchy = fit(spec, demos.select(demos.names[: self.demonstrations]), folder)
        first = EVALUATION + 1000 * self.seed
        goals = {}
        for way in ACTING[self.method][1]:
            controller = Controller.from_spec(hierarchy, spec.rollout.model_copy(update={"options": way}))
            goals[way] = summary(play(pushing.task, controller, range(first, first + EPISODES)))["goals"]
        return {"nats": per_step(Fit(spec, hierarchy), held_out(settings.runs, spec)), "goals": goals}

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Means over episodes, and the held-out likelihood."""
        named = "pushing", "pushing", ACTING[self.method][0], self.demonstrations, self.seed
        yield Row(*named, "nats", results["nats"])
        for way, goals in results["goals"].items():
            yield Row(*named, f"goals, acting by {way}", float(np.mean(goals)))


def spec_of(cell: PushingCell) -> Spec:
    """The spec of a cell, with what the sweep chose for its method."""
    file, overrides = METHODS[cell.method]
    variant, updates = VARIANTS[cell.variant]
    chosen = json.loads(SETTINGS.read_text())[cell.method]
    changed = {**overrides, **chosen, **variant, "seed": cell.seed, "demonstrations.count": cell.demonstrations}
    if cell.options:
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


def pool(folder: Path, spec: Spec) -> Demonstrations:
    """All demonstrations of a spec's supervisor and training seed."""
    return demonstrations(folder, spec.demonstrations.supervisor, TRAINING + 1000 * spec.seed, POOL)


def held_out(folder: Path, spec: Spec) -> Demonstrations:
    """Demonstrations of a spec's supervisor that nothing is trained on."""
    return demonstrations(folder, spec.demonstrations.supervisor, HELD_OUT_SEED, HELD_OUT)


def fit(spec: Spec, demos: Demonstrations, checkpoints: Path) -> Hierarchy:
    """The fitted hierarchy."""
    return train_model(spec, Dimensions.of(demos), demos, checkpoints=checkpoints).hierarchy


def per_step(fit: Fit, demos: Demonstrations) -> float:
    """Log-likelihood per step, nats, at the spec's σ."""
    return float(fit.log_likelihood(demos).sum() / sum(demos.lengths))


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


def cells(own: argparse.Namespace) -> list[PushingCell]:
    """The part of a study that is asked for, one seed after the other."""
    kind = ActingCell if own.study == "acting" else PushingCell
    return [
        kind(method, k, count, seed, variant, own.study)
        for seed in range(own.first, own.first + own.seeds)
        for method, k, count, variant in grid(own.study)
        if method in own.methods and count in own.demonstrations and variant in own.variants
        if own.study in ("sample_complexity", "variants", "acting") or k in own.options
    ]


def grid(study: str) -> Iterator[tuple[str, int, int, str]]:
    """Method, options, demonstrations and variant of each cell of a seed."""
    if study == "sample_complexity":
        methods = [name for name in METHODS if not name.startswith(("hybrid", "mixture"))]
        for count, name in itertools.product(COUNTS, methods):
            yield name, OWN_OPTIONS.get(name, 0), count, "base"
    elif study == "acting":
        for count, name in itertools.product(COUNTS, ACTING):
            yield name, OWN_OPTIONS[name], count, "base"
    elif study == "variants":
        for variant, count, name in itertools.product(VARIANTS, (40, 80), ("flat MLP", EQUAL, "DDCO MLP")):
            if name in OWN_OPTIONS or variant != "most likely options":
                yield name, OWN_OPTIONS.get(name, 0), count, variant
    else:
        other = "DDCO linear" if study == "number_of_options" else "hybrid MLP"
        for name, k in itertools.product(("DDCO MLP", other), OPTIONS):
            yield name, k, 40, "base"


def main() -> None:
    """Run one study."""
    parser = described(__doc__)
    studies = ["sample_complexity", "number_of_options", "augmentation", "variants", "acting"]
    parser.add_argument("study", choices=studies)
    parser.add_argument("--first", type=int, default=0, help="the first training seed")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--demonstrations", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--options", type=int, nargs="+", default=OPTIONS)
    parser.add_argument("--methods", nargs="+", default=tuple(METHODS), choices=METHODS)
    parser.add_argument("--variants", nargs="+", default=tuple(VARIANTS), choices=VARIANTS)
    study.main("pushing", parser, DEFAULTS, cells)


if __name__ == "__main__":
    main()
