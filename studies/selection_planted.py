"""Does the one-standard-error rule find the number of options that was planted?

    python studies/selection_planted.py [--options 1 3 5] [--draws 10] [--folds 10] [--most 8] [--jobs -1]

Draws demonstrations of k linear skills, selects among 1 to ``--most`` options by cross-validation, and counts how often
k is chosen. All k of a draw come before the next draw, and what ``docs/results/selection_planted.json`` has already is
not done again; ``selection_planted.md`` beside it has the counts.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from provenance import Record, record, sentence, text

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import write_text
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
            "initialize": "vq",
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


def draw(options: int, seed: int, folds: int, most: int, jobs: int, made_by: Record) -> dict[str, Any]:
    """One selection: what was planted, chosen and best, and the differences to the best."""
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "planted.hdf5"
        plant(options, seed).write(path)
        spec = planted_spec(path, folds, most, seed)
        claim(Path(folder) / "run", spec)
        found = select(spec, Path(folder) / "run", workers=Workers(jobs)).choice
    assert found.best is not None
    assert found.chosen is not None
    return {
        "options": options,
        "seed": seed,
        "made_by": made_by,
        "chosen": found.chosen.candidate.number + 1,
        "best": found.best.candidate.number + 1,
        "means": [row.mean for row in found.rows],
        "best_standard_error": found.best.error,
        "differences": [row.difference for row in found.rows],
        "failed": sum(len(row.failed) for row in found.rows),
        "cpu_seconds": time.process_time() - start,  # of this process; of all the work where --jobs is 1
    }


def table(rows: list[dict[str, Any]], made_by: str) -> str:
    """How often what was planted was chosen, as Markdown."""
    lines = [
        made_by,
        "",
        "| planted | chosen | right | best instead | right |",
        "|--:|---|--:|---|--:|",
    ]
    for options in dict.fromkeys(row["options"] for row in rows):
        own = [row for row in rows if row["options"] == options]
        counts = [f"{sum(row[key] == options for row in own)} of {len(own)}" for key in ("chosen", "best")]
        chosen, best = (", ".join(str(row[key]) for row in own) for key in ("chosen", "best"))
        lines.append(f"| {options} | {chosen} | {counts[0]} | {best} | {counts[1]} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--options", type=int, nargs="+", default=[1, 3, 5])
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--folds", type=int, default=10)
    parser.add_argument("--most", type=int, default=8)
    parser.add_argument("--jobs", type=int, default=-1)
    own = parser.parse_args()
    command = (
        f"python studies/selection_planted.py --options {' '.join(map(str, own.options))} --draws {own.draws} "
        f"--folds {own.folds} --most {own.most}"
    )
    made_by = record(command)
    settings = {"folds": own.folds, "most": own.most}
    path = OUT / "selection_planted.json"
    stored = json.loads(path.read_text()) if path.exists() else {"results": {"draws": []} | settings}
    kept = stored["results"]
    if any(kept[key] != value for key, value in settings.items()):
        raise SystemExit(f"{path}: was made with other --folds or --most; remove it first")
    for row in kept["draws"]:
        row.setdefault("made_by", stored["provenance"][0])  # draws that were adopted as a whole
    done = {(row["seed"], row["options"]): row for row in kept["draws"]}
    wanted = list(product(range(FIRST_SEED, FIRST_SEED + own.draws), own.options))
    for seed, options in wanted:
        if (seed, options) not in done:
            done[seed, options] = draw(options, seed, own.folds, own.most, own.jobs, made_by)
            print(done[seed, options], flush=True)
        rows = [done[key] for key in sorted(done, key=lambda key: (key[1], key[0]))]
        page = table(rows, sentence(command, (row.get("made_by") for row in rows)))
        write_text(path, text(settings | {"draws": rows}, (row.get("made_by") for row in rows)))
        write_text(OUT / "selection_planted.md", page)
    print(page)


if __name__ == "__main__":
    main()
