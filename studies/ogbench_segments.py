"""Phases and objects of OGBench's manipulation tasks: options, with and without labels, beside what else segments.

    python -m studies.ogbench_segments [--tasks cube-single scene ...] [--levels phase object] [--labelled 0 1 3]
        [--seeds 3] [--noise 0.0] [--jobs 2]

The demonstrations are those of OGBench's own scripted oracles (Park and others, 2025), recorded in an environment of
its own from ``ogbench_requirements.txt`` by ``ogbench_manipspace.py``, which says what labels are. ``phase`` is what an
oracle does, ``object`` what it does it to. A training seed draws 40 of 100 demonstrations; the held-out twenty are the
same. The spec is what ``ddco-pyro init`` writes for a file with the labels of one level. A cell that was done is not
done again. Adds its numbers to ``docs/results/ogbench.csv``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from studies import people, study
from studies.apart import HELD_OUT, Apart
from studies.people import LABELS, PeopleCell
from studies.study import Row, Settings, described

RECORDED, TRAINED = 120, 40
TASKS = ("cube-single", "scene", "cube-double", "puzzle-3x3")
"""The last two are those on which nothing was chosen."""
OBJECTS = {"scene": 5, "cube-double": 2, "puzzle-3x3": 9}
"""Of tasks with several."""
DEFAULTS = Settings({"seed": 0, "noise": 0.0}, Path("runs/ogbench"))
GRIPPER, LEARNED = 4, {"learn": True, "floor": 0.01, "per_option": True}
"""The control dimension, and ``control.std`` as init writes it."""
LINEAR = {"policy": {"network": "linear"}, "termination": {"network": "linear"}}
"""A level, as init writes it."""
STICKINESS = (0.0, 1e3, 1e5)
"""Pseudo-counts of staying that are tried for an AR-HMM."""


def simulator(settings: Settings) -> Apart:
    """OGBench in its environment."""
    return Apart("ogbench_manipspace.py", "ogbench_requirements.txt", settings.runs)


@dataclass(frozen=True)
class OGBenchCell(PeopleCell):
    """A task, a training seed, how many demonstrations have labels, and which of the two levels is compared."""

    level: str = "phase"

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.task}-{self.level}-{self.fold}-{self.labelled}"

    @property
    def further(self) -> dict[str, dict[str, Any]]:
        """Controls that are Gaussian, and not clipped or a switch: all, or the gripper's alone. Objects: two levels."""
        if self.level == "object":
            below, above = {**LINEAR, "count": 4}, {**LINEAR, "count": OBJECTS[self.task], "name": "object"}
            return {"options, two levels": {"hierarchy.levels": [below, above], "demonstrations.labels": None}}
        gripper = {"name": "gripper", "dims": [GRIPPER], "kind": "gaussian", "std": LEARNED}
        return {
            "options, Gaussian": {"control.kind": "gaussian"},
            "options, Gaussian gripper": {"control.parts": [gripper]},
        }

    def demonstrations(self, settings: Settings) -> tuple[Path, Demonstrations]:
        """A file with the labels of the level alone, and the demonstrations of the seed."""
        noise, level = settings.values["noise"], self.level
        path = simulator(settings).collected(self.task, number=RECORDED, held_out=HELD_OUT, noise=noise, labels=level)
        demos = Demonstrations.read(path, labels=[level])
        train, valid = (list(demos.masks[part]) for part in ("train", "valid"))
        drawn = np.random.default_rng(int(self.fold.removeprefix("seed-"))).permutation(len(train))[:TRAINED]
        masks = {"train": tuple(train[place] for place in sorted(drawn)), "valid": tuple(valid)}
        each = (replace(demo, labels={**demo.labels, LABELS: demo.labels[self.level]}) for demo in demos)
        return path, replace(replace(demos, demonstrations=tuple(each)).select(sum(masks.values(), ())), masks=masks)

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, and compare with the labels of the held-out demonstrations."""
        return {**super().results(settings, folder), "noise": settings.values["noise"]}

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Agreement of each method, and what cross-validation chose; noise on the controls is another study."""
        noise = f" with noise {results['noise']:g}" if results.get("noise") else ""
        for row in super().rows(results):
            yield row._replace(study=f"{self.level}{noise}")


def cells(own: argparse.Namespace) -> list[OGBenchCell]:
    """All of a seed before another."""
    return [
        OGBenchCell("", task, f"seed-{seed}", labelled, level)
        for seed, labelled, level, task in itertools.product(range(own.seeds), own.labelled, own.levels, own.tasks)
        if level == "phase" or task in OBJECTS
    ]


def main() -> None:
    """Run the study."""
    people.BASELINES = {"k-means": "kmeans", **people.BASELINES}
    people.STICKINESS = STICKINESS
    parser = described(__doc__)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--levels", nargs="+", default=["phase", "object"], choices=["phase", "object"])
    parser.add_argument("--labelled", nargs="+", default=["0", "1", "3"])
    parser.add_argument("--seeds", type=int, default=3)
    study.main("ogbench", parser, DEFAULTS, cells, lambda settings: simulator(settings).made())


if __name__ == "__main__":
    main()
