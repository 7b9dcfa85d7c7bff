"""How a task's models are best trained, chosen on held-out likelihood of demonstrations that no result is about.

    python studies/recipe.py [--spec specs/needle.yaml] [--seeds 5000 6000] [--folds 3] [--jobs -1] [--out runs/recipe]

For each development seed, which has demonstrations of its own, ``select`` scores every candidate of a grid over the
recipe, the hierarchy's and the flat policies' alike; scores in ``--out`` are not made again. Writes
``docs/results/recipe.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.selection import Workers, select
from ddco_pyro.spec import Spec, load_spec, with_overrides

SHARED, OWN = ({"learn": True, "floor": 0.02, "per_option": own} for own in (False, True))
RECIPE = {
    "training.initialize": ["vq_controls", "random"],
    "training.layerwise": [True, False],
    "training.restarts": [1, 3],
    "control.std": [SHARED, OWN],
}
GRIDS: dict[str, dict[str, list[Any]]] = {
    "ddco": RECIPE,
    "flat": {
        "training.restarts": [1, 3],
        "training.optimizer.lr": [3e-3, 1e-3],
        "baseline.policy.hidden": [[64], [128], [256], [609]],
    },
}
"""Sixteen candidates of each model; flat policies have up to the hierarchy's parameters."""
OUT = Path("docs/results/recipe")


def spec_of(path: str, model: str, seed: int, folds: int) -> Spec:
    """The spec of one model's selection, with demonstrations of the seed's own."""
    spec = load_spec(path, [f"demonstrations.seed={seed}", f"seed={seed}", "compare_with=[]"])
    if model == "flat":
        flat = {"kind": "flat", "policy": {"network": "mlp", "hidden": [64]}}
        spec = with_overrides(spec, {"hierarchy": None, "baseline": flat})
    return with_overrides(spec, {"selection.folds": folds, "selection.grid": GRIDS[model]})


def scored(spec: Spec, folder: Path, jobs: int) -> list[dict[str, Any]]:
    """Every candidate's held-out log-likelihood per step over the folds."""
    selection = select(spec, folder, workers=Workers(jobs))
    return [
        {"candidate": row.candidate.name, "values": dict(row.candidate.values), "valid": row.mean, "error": row.error}
        for row in selection.choice.rows
    ]


def table(results: dict[str, dict[str, list[dict[str, Any]]]], made_by: str) -> str:
    """Candidates by their mean over the seeds, the best first, as Markdown."""
    lines = [made_by, ""]
    for model, by_seed in results.items():
        seeds = list(by_seed)
        lines += [
            f"| {model} | {' | '.join(f'seed {seed}' for seed in seeds)} | mean |",
            "|---" * (len(seeds) + 2) + "|",
        ]
        names = [row["candidate"] for row in by_seed[seeds[0]]]
        values = {name: [by_seed[seed][place]["valid"] for seed in seeds] for place, name in enumerate(names)}
        for name, cells in sorted(values.items(), key=lambda item: -np.mean(item[1])):
            lines.append(f"| {name} | {' | '.join(f'{cell:.2f}' for cell in cells)} | {np.mean(cells):.2f} |")
        lines.append("")
    return "\n".join([*lines, "Held-out nats per step, mean over the folds."]) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spec", default="specs/needle.yaml")
    parser.add_argument("--seeds", type=int, nargs="+", default=[5000, 6000])
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--out", type=Path, default=Path("runs/recipe"))
    arguments = parser.parse_args()
    seeds = " ".join(map(str, arguments.seeds))
    made_by = record(f"python studies/recipe.py --spec {arguments.spec} --seeds {seeds} --folds {arguments.folds}")
    results: dict[str, dict[str, list[dict[str, Any]]]] = {model: {} for model in GRIDS}
    for seed in arguments.seeds:
        for model in GRIDS:
            spec = spec_of(arguments.spec, model, seed, arguments.folds)
            results[model][str(seed)] = scored(spec, arguments.out / f"{model}-{seed}", arguments.jobs)
            write_text(OUT.with_suffix(".json"), text(results, [made_by]))
    write_text(OUT.with_suffix(".md"), table(results, sentence(made_by["command"], [made_by])))
    print(OUT.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
