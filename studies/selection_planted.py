"""Does the one-standard-error rule find the number of options that was planted?

    python studies/selection_planted.py [--options 1 3 5] [--draws 10] [--folds 5] [--most 6] [--jobs -1]

Draws demonstrations of k linear skills, selects among 1 to ``--most`` options by cross-validation, and counts how often
k is chosen. Adds its numbers to ``docs/results/selection.csv``.
"""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path

import numpy as np
from study import RESULTS, Row, add, described

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.fitting.run import claim
from ddco_pyro.selection import Workers, select
from ddco_pyro.spec import Spec, parse_spec

OUT = Path("docs/results")
FIRST_SEED = 400  # those below were looked at while this study was made
STEPS = 20
LASTING = 0.8  # probability that a skill goes on at the next step
HINT_NOISE = 0.15  # of a circle of radius 1, on which each skill has its place
PLACE = 0.4  # spread of where a skill is applied, less than that of the hints: clusters start from the hints
CONTROL_NOISE = 0.3


def plant(options: int, seed: int, count: int = 60) -> Demonstrations:
    """Demonstrations of k linear skills that take turns: a_t = A_h x_t + noise, with x_t seen as ``place``; ``hint`` is
    a noisy point on a circle that tells which skill is on. No two skills are alike, and no one policy does two of them.
    """
    random = np.random.default_rng([options, seed])
    angles = 2 * np.pi * np.arange(options) / options
    turn = random.uniform(0, 2 * np.pi)
    skills = [_rotation(angle + turn) * random.uniform(2.0, 4.0) for angle in angles]
    records = []
    for number in range(count):
        active = [int(random.integers(options))]
        while len(active) < STEPS:
            lasts = random.random() < LASTING
            active.append(active[-1] if lasts else int(random.integers(options)))
        place = PLACE * random.normal(size=(STEPS, 2))
        hint = np.stack([np.cos(angles[active]), np.sin(angles[active])], 1)
        hint += HINT_NOISE * random.normal(size=hint.shape)
        control = np.stack([skills[h] @ x for h, x in zip(active, place, strict=True)])
        control += CONTROL_NOISE * random.normal(size=control.shape)
        labels = {"skill": np.array(active)}
        records.append(Demonstration(f"demo_{number}", {"place": place, "hint": hint}, control, labels))
    return Demonstrations(tuple(records))


def _rotation(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def planted_spec(path: Path, folds: int, most: int, seed: int) -> Spec:
    """Linear options of which the number is to be found."""
    data = {
        "demonstrations": {"path": str(path)},
        "observations": [{"key": "place", "standardize": False}, {"key": "hint", "standardize": False}],
        "control": {"std": {"learn": True, "floor": 0.05}, "scale": "none"},
        "hierarchy": {
            "levels": [{"count": 1, "policy": {"network": "linear"}, "termination": {"network": "linear"}}],
            "meta_policy": {"network": "linear"},
        },
        "training": {
            "starts": ["vq"],
            "layerwise": False,
            "epochs": 80,
            "patience": 10,
            "batch_size": 20,
            "optimizer": {"lr": 0.05},
            "tune_fraction": 0.2,
        },
        "selection": {"folds": folds, "grid": {"hierarchy.levels.0.count": list(range(1, most + 1))}},
        "seed": seed,
    }
    return parse_spec(data)


def draw(options: int, seed: int, folds: int, most: int, jobs: int) -> list[Row]:
    """One selection: how many options the rule chooses, and how many are the likeliest."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "planted.hdf5"
        plant(options, seed).write(path)
        spec = planted_spec(path, folds, most, seed)
        claim(Path(folder) / "run", spec)
        found = select(spec, Path(folder) / "run", workers=Workers(jobs)).choice
    assert found.best is not None
    assert found.chosen is not None
    return [
        Row("selection_planted", f"{options} planted", "ddco", None, seed, measure, row.candidate.number + 1)
        for measure, row in (("chosen", found.chosen), ("likeliest", found.best))
    ]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--options", type=int, nargs="+", default=[1, 3, 5])
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--most", type=int, default=6)
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--out", type=Path, default=RESULTS / "selection.csv")
    own = parser.parse_args()
    for seed, options in product(range(FIRST_SEED, FIRST_SEED + own.draws), own.options):
        found = draw(options, seed, own.folds, own.most, own.jobs)
        add(own.out, found)
        print(*(f"{row.task}, {row.measure}: {row.value:g}" for row in found), sep="; ", flush=True)


if __name__ == "__main__":
    main()
