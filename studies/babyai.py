"""Options at two levels on BabyAI, whose bot keeps a stack of subgoals: truth for both of them.

    python studies/babyai.py [--levels GoToSeqS5R2 ...] [--progress hidden told] [--seeds 2] [--episodes 50] [--jobs 1]
        [--set KEY=VALUE]... [--demonstrations 80] [--out DIR] [--runs DIR]

Records minigrid's bot in an environment of its own (``RUNS/venv``), fits one level of options, two, and policies
without options, and lets them act. A cell (level, progress, seed) that was done with these settings is not done
again. Adds its numbers to ``docs/results/babyai.csv``.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import study
from apart import HELD_OUT, Apart, expert
from study import Cell, Row, Settings, described

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.segmenting import baselines
from ddco_pyro.spec import load_spec

LEVELS = ("GoToSeqS5R2", "MoveTwoAcrossS5N2", "MiniBossLevel")
LABELS = ("subgoal", "mission")
COUNTS = (5, 3)
"""Options of each level, lowest first."""
PROGRESS = ("hidden", "told")
TOLD = "done"
"""The observation that is left out where progress is hidden."""
REFERENCES = ("equal", "kmeans")
"""Segmentations without options, to compare with; beside them a single segment."""
PERCEPTRON: dict[str, Any] = {"network": "mlp", "hidden": [32]}
LINEAR: dict[str, Any] = {"network": "linear"}

DEFAULTS = Settings({"demonstrations": 80, "episodes": 50}, Path("runs/babyai"))
"""Recorded for each level, with those that are held out; and what each method plays."""


@dataclass(frozen=True)
class BabyAICell(Cell):
    """A level, what is said of its progress, and the seed of training."""

    level: str
    progress: str
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, play, and compare the options with what the bot was about."""
        begun, world, own = time.perf_counter(), gridworld(settings), settings.values
        source = world.collected(self.level, number=own["demonstrations"], held_out=HELD_OUT)
        demos = Demonstrations.read(source, observed(source, self.progress), list(LABELS))
        fits = {name: fitted(self, source, demos, name, folder, settings.overrides) for name in ("one", "two")}
        methods = {"flat": fits["one"].baselines["flat"], "flat_equal": fits["one"].baselines["flat_equal"], **fits}
        trained = time.perf_counter()
        played = world.play(self.level, methods, source, int(own["episodes"]))
        ended = time.perf_counter()
        valid = demos.select(demos.masks["valid"])
        return {
            "demonstrations_sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
            "trained": len(demos.masks["train"]),
            "bot": expert(source) | {"steps": list(map(len, demos))},
            "methods": {
                name: {
                    "log_likelihood_per_step": one.metrics.log_likelihood_per_step.model_dump(),
                    "parameters": one.metrics.parameters,
                    "converged": one.metrics.training.converged,
                    "bridge_difference": played["differences"][name],
                }
                for name, one in methods.items()
            },
            "played": {
                name: {key: [one[key] for one in episodes] for key in ("success", "steps")}
                for name, episodes in played["episodes"].items()
            },
            "agreement": {name: one.metrics.model_dump()["agreement"] for name, one in fits.items()},
            "crossed": {name: crossed(one.segment(valid), valid) for name, one in fits.items()},
            "references": references(demos, valid, self.seed),
            "options": {name: one.metrics.model_dump()["options"] for name, one in fits.items()},
            "seconds": {"fit": trained - begun, "play": ended - trained, "all": ended - begun},
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Likelihood and success of each method, and agreement of the options with what the bot was about."""
        task, count = f"{self.level}, {self.progress}", results["trained"]
        for method, one in results["methods"].items():
            nats = one["log_likelihood_per_step"]["valid"]
            yield Row("babyai", task, method, count, self.seed, "nats", nats)
        for method, one in results["played"].items():
            yield Row("babyai", task, method, count, self.seed, "success", float(np.mean(one["success"])))
        crossed = {f"{fit}, level {number}": one for fit, own in results["crossed"].items()
                   for number, one in enumerate(own, 1)}  # fmt: skip
        for method, labels in (crossed | results["references"]).items():
            for label, found in labels.items():
                if found:
                    yield Row("babyai", task, method, count, self.seed, f"NMI with {label}", found["nmi"])


def gridworld(settings: Settings) -> Apart:
    """minigrid, in an environment of its own."""
    return Apart("babyai_minigrid.py", "babyai_requirements.txt", settings.runs)


def observed(source: Path, progress: str) -> list[str]:
    """The observations that vary in the training demonstrations, without what is told where progress is hidden."""
    with h5py.File(source) as file:
        names = [name.decode() for name in file["mask/train"]]
        keys = [key for key in file[f"data/{names[0]}/obs"] if key != TOLD or progress == "told"]
        rows = {key: np.concatenate([file[f"data/{name}/obs/{key}"][()] for name in names]) for key in keys}
    return [key for key, values in rows.items() if np.ptp(values, axis=0).any()]


def rule(source: Path, keys: list[str], levels: int, seed: int) -> dict[str, Any]:
    """The spec of a hierarchy, whatever the level of BabyAI."""
    names = ("option", "plan")[:levels]
    return {
        "demonstrations": {"path": str(source.resolve()), "labels": list(LABELS[:levels])},
        "observations": keys,
        "control": {"kind": "categorical"},
        "hierarchy": {
            "levels": [
                {"name": name, "count": count, "policy": PERCEPTRON, "termination": LINEAR}
                for name, count in zip(names, COUNTS, strict=False)
            ],
            "meta_policy": LINEAR,
        },
        "training": {
            "starts": ["vq_controls"],
            "optimizer": {"name": "adam", "lr": 3e-3, "weight_decay": 1e-3},
            "epochs": 400,
            "patience": 50,
            "batch_size": 16,
        },
        "rollout": {"control": "sample"},  # the most likely action may turn round for ever
        "compare_with": [{"kind": kind, "policy": PERCEPTRON} for kind in ("flat", "flat_equal")]
        if levels == 1
        else [],
        "seed": seed,
    }


def fitted(
    cell: BabyAICell, source: Path, demos: Demonstrations, name: str, folder: Path, overrides: tuple[str, ...]
) -> Fit:
    """A fit of one level of options, with the policies without options, or of two."""
    levels = {"one": 1, "two": 2}[name]
    path = folder / f"{name}.yaml"
    write_text(path, json.dumps(rule(source, list(demos.observation_shapes), levels, cell.seed), indent=1))
    return fit(load_spec(path, list(overrides)), demos, out=folder / name)


def scores(segments: list[np.ndarray], truth: list[np.ndarray]) -> dict[str, Any] | None:
    """The measures of agreement as plain data."""
    found = agreement(segments, truth)
    return found and found.model_dump()


def crossed(levels: Iterable[Sequence[np.ndarray]], demos: Demonstrations) -> list[dict[str, Any]]:
    """Agreement of each level's options with each of the labels."""
    return [{label: scores(rows, [demo.labels[label] for demo in demos]) for label in LABELS} for rows in levels]


def references(demos: Demonstrations, valid: Demonstrations, seed: int) -> dict[str, dict[str, Any]]:
    """Agreement of segmentations without options, with as many kinds as a level of options has."""
    train = demos.select(demos.masks["train"])
    found: dict[str, dict[str, Any]] = {name: {} for name in ("constant", *REFERENCES)}
    for label, count in zip(LABELS, COUNTS, strict=True):
        truth = [demo.labels[label] for demo in valid]
        found["constant"][label] = scores([np.zeros_like(one) for one in truth], truth)
        for name in REFERENCES:
            found[name][label] = scores(baselines.segment(name, train, valid, count, seed), truth)
    return found


def cells(own: argparse.Namespace) -> list[BabyAICell]:
    """All of a seed before another."""
    product = itertools.product(range(own.seeds), own.levels, own.progress)
    return [BabyAICell(level, progress, seed) for seed, level, progress in product]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), metavar="LEVEL")
    parser.add_argument("--progress", nargs="+", choices=PROGRESS, default=list(PROGRESS))
    parser.add_argument("--seeds", type=int, default=2)
    study.main("babyai", parser, DEFAULTS, cells, lambda settings: gridworld(settings).made())


if __name__ == "__main__":
    main()
