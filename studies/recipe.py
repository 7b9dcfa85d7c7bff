"""How a task's models are best trained and executed, chosen on development seeds that no result is about.

    python studies/recipe.py [--grid initialization | decay | trunk] [--counts 100] [--spec specs/needle.yaml]
        [--seeds 5000 6000] [--episodes 60] [--jobs 2] [--out DIR]

Each development seed has demonstrations of its own. Baselines have as many settings as the hierarchy, which also has
the recipe of before; each is trained once for each seed, scored on held-out demonstrations, and rolled out from starts
that no result is about. A hierarchy acts in two ways, so it is chosen among 34 candidates and a baseline among 16 (of
``decay`` among 12 and 6).
``--grid initialization`` tries how options begin, ``decay`` how much weights decay and what policy and termination of
an option share, ``trunk`` a network that the whole hierarchy reads (fewer candidates than ``decay`` has for each model;
the hierarchy alone has such a thing); ``--counts`` trains on the first demonstrations of a seed. A cell that is in
``--out`` is not made again by the same code. Writes ``docs/results/recipe.json`` and ``.md``, or ``recipe_GRID``.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from cells import printed
from joblib import Parallel, delayed
from provenance import Record, is_kept, record, sentence, text
from scipy import stats

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.simulation.episodes import play
from ddco_pyro.simulation.task import find_task
from ddco_pyro.spec import Spec, load_spec, with_overrides

STARTS = 500_000  # seed of the first episode
EXECUTIONS = ("most_likely", "marginal")
PERCEPTRON: dict[str, Any] = {"network": "mlp", "hidden": [64]}
BEFORE: dict[str, Any] = {
    "training.initialize": "vq_controls",
    "training.layerwise": True,
    "training.optimizer.weight_decay": 0.0,
    "control.std": {"learn": True, "floor": 0.02},
    "hierarchy.levels.0.termination": PERCEPTRON,
    "hierarchy.meta_policy": PERCEPTRON,
}
OWN_STD = {"learn": True, "floor": 0.02, "per_option": True}
INITIALIZE = ("vq", "vq_controls", "equal_parts", "random")
DECAYS = (0.0, 1e-3)
RATES = (3e-3, 1e-3)
Candidate = dict[str, Any]
Cell = dict[str, Any]


def beginnings() -> dict[str, list[Candidate]]:
    """For each model the settings to try; sixteen each, and for the hierarchy besides the recipe of before."""
    ours = [
        {
            **BEFORE,
            "training.layerwise": False,
            "control.std": OWN_STD,
            "training.initialize": initialize,
            "training.optimizer.weight_decay": decay,
            "hierarchy.levels.0.termination": switching,
            "hierarchy.meta_policy": switching,
        }
        for initialize, decay, switching in product(INITIALIZE, DECAYS, (PERCEPTRON, {"network": "linear"}))
    ]
    flat = [_baseline("flat", *values) for values in product(([64], [128], [256], [609]), DECAYS, RATES)]
    clock = [_baseline("per_timestep", *values) for values in product(([8], [16], [32], [64]), DECAYS, RATES)]
    return {"ddco": [BEFORE, *ours], "flat": flat, "per_timestep": clock}


def decays() -> dict[str, list[Candidate]]:
    """For each model, as the first grid left it, six settings to try."""
    apart = {"hierarchy.levels.0.policy": PERCEPTRON, "hierarchy.levels.0.termination": PERCEPTRON}
    linear = {"network": "linear"}
    shared = {f"hierarchy.levels.0.{part}": linear for part in ("policy", "termination")}
    networks = (apart, shared | {"hierarchy.levels.0.trunk": PERCEPTRON})
    begun = {"training.initialize": "equal_parts", "training.layerwise": False, "control.std": OWN_STD}
    ours = [
        {**begun, **own, "training.optimizer.weight_decay": decay}
        for own, decay in product(networks, (1e-3, 1e-2, 3e-2))
    ]
    others = {"flat": [609], "per_timestep": [64]}
    return {"ddco": ours} | {
        kind: [_baseline(kind, hidden, *values) for values in product((1e-3, 1e-2, 3e-2), RATES)]
        for kind, hidden in others.items()
    }


def trunks() -> dict[str, list[Candidate]]:
    """Linear policies, terminations and meta-policy over a hidden layer that all of them read; four settings."""
    linear = {"network": "linear"}
    heads = {f"hierarchy.{place}": linear for place in ("levels.0.policy", "levels.0.termination", "meta_policy")}
    begun = {"training.initialize": "equal_parts", "training.layerwise": False, "control.std": OWN_STD}
    sizes_and_decays = product(([64], [128]), (1e-2, 3e-2))
    return {
        "ddco": [
            {
                **begun,
                **heads,
                "hierarchy.trunk": {"network": "mlp", "hidden": hidden},
                "training.optimizer.weight_decay": decay,
            }
            for hidden, decay in sizes_and_decays
        ]
    }


GRIDS = {
    "initialization": (beginnings, "recipe"),
    "decay": (decays, "recipe_decay"),
    "trunk": (trunks, "recipe_trunk"),
}
"""What is tried, and the name of its results."""


def _baseline(kind: str, hidden: list[int], decay: float, rate: float) -> Candidate:
    return {
        "hierarchy": None,
        "baseline": {"kind": kind, "policy": {"network": "mlp", "hidden": hidden}},
        "training.optimizer.weight_decay": decay,
        "training.optimizer.lr": rate,
    }


def run_cell(
    path: str, count: int, seed: int, candidate: Candidate, episodes: int, kept: Path, made_by: Record
) -> Cell:
    """One candidate on one development seed: held-out nats per step, and successes with each execution of options."""
    settings = {"spec": path, "count": count, "seed": seed, "values": candidate, "episodes": episodes}
    if kept.exists():
        content = json.loads(kept.read_text())
        if is_kept(content, settings, made_by):
            return dict(content["results"])
    spec = load_spec(path, [f"demonstrations.seed={seed}", f"seed={seed}", "compare_with=[]"])
    left_out = [f"demo_{seed + number}" for number in range(count, spec.demonstrations.count)]
    spec = with_overrides(spec, {**candidate, "demonstrations.exclude": left_out})
    with one_thread():
        fitted = ddco_pyro.fit(spec)
        success = {
            execution: successes(fitted, spec, execution, episodes)
            for execution in (EXECUTIONS if spec.hierarchy else EXECUTIONS[:1])
        }
    found = settings | {"valid": fitted.metrics.log_likelihood_per_step.valid, "success": success}
    write_text(kept, text(found, [made_by]))
    return found


def successes(fitted: Fit, spec: Spec, execution: str, episodes: int) -> int:
    """Of how many episodes a policy succeeds."""
    rollout = spec.rollout.model_copy(update={"options": execution})
    seeds = range(STARTS, STARTS + episodes)
    return int(
        sum(
            one.outcome["success"]
            for one in play(find_task(str(spec.task)), Controller.from_spec(fitted.hierarchy, rollout), seeds)
        )
    )


def summarize(cells: list[Cell], seeds: list[int]) -> list[dict[str, Any]]:
    """Candidates with each execution, by their mean success over the seeds and then by likelihood, the best first."""
    rows = []
    for values in {json.dumps(cell["values"]): cell["values"] for cell in cells}.values():
        own = [next(cell for cell in cells if cell["values"] == values and cell["seed"] == seed) for seed in seeds]
        for execution in own[0]["success"]:
            rows.append(
                {
                    "values": values,
                    "execution": execution,
                    "success": [cell["success"][execution] for cell in own],
                    "valid": [cell["valid"] for cell in own],
                }
            )
    return sorted(rows, key=lambda row: (-np.mean(row["success"]), -np.mean(row["valid"])))


def page(models: dict[str, list[dict[str, Any]]], seeds: list[int], episodes: int, made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", f"Successes of {episodes} and held-out nats per step on development seeds {seeds}.", ""]
    for model, rows in models.items():
        lines += [f"## {model}", "", "| candidate | options | successes | held-out nats/step |", "|---|---|---|---|"]
        for row in rows:
            nats = ", ".join(f"{value:.2f}" for value in row["valid"])
            execution = row["execution"] if model.startswith("ddco") else "–"
            lines.append(f"| {words(row['values'])} | {execution} | {', '.join(map(str, row['success']))} | {nats} |")
        pairs = np.array([[np.mean(row["success"]), np.mean(row["valid"])] for row in rows])
        lines += ["", f"Spearman's correlation of the two: {stats.spearmanr(*pairs.T).statistic:.2f}.", ""]
    return "\n".join(lines)


def words(values: Candidate) -> str:
    """What a candidate sets."""
    if values == BEFORE:
        return "the recipe of before: clusters of observations and controls, layer by layer, one σ, perceptrons switch"
    if "baseline" in values:
        said = [f"hidden {values['baseline']['policy']['hidden']}", f"lr {values['training.optimizer.lr']}"]
    elif "hierarchy.trunk" in values:
        said = [f"all read one hidden layer {values['hierarchy.trunk']['hidden']}"]
    elif "hierarchy.meta_policy" in values:
        switching = values["hierarchy.meta_policy"]["network"]
        said = [values["training.initialize"], f"{'perceptrons' if switching == 'mlp' else switching} switch"]
    else:
        shared = "hierarchy.levels.0.trunk" in values
        said = [f"policy and termination of an option {'share a hidden layer' if shared else 'apart'}"]
    return ", ".join([*said, f"decay {values['training.optimizer.weight_decay']}"])


def run(own: argparse.Namespace) -> str:
    """The study; its page."""
    grid, name = GRIDS[own.grid]
    seeds, counts = " ".join(map(str, own.seeds)), " ".join(map(str, own.counts))
    command = f"python studies/recipe.py --grid {own.grid} --counts {counts} --spec {own.spec} --seeds {seeds} "
    made_by = record(f"{command}--episodes {own.episodes}")
    for seed in own.seeds:  # collected by whoever comes first, and only once
        ddco_pyro.training.data.demonstrations(load_spec(own.spec, [f"demonstrations.seed={seed}"]))
    models, summary = {}, ""
    for count, (model, tried) in product(own.counts, grid().items()):
        calls = [
            delayed(run_cell)(
                own.spec,
                count,
                seed,
                values,
                own.episodes,
                own.out / f"{name}-{model}-{number}-{count:03d}-{seed}.json",
                made_by,
            )
            for seed in own.seeds
            for number, values in enumerate(tried)
        ]
        models[f"{model}, {count} demonstrations"] = summarize(Parallel(n_jobs=own.jobs)(calls), own.seeds)
        out = Path(f"docs/results/{name}.json")
        write_text(out, text(models, [made_by]))
        summary = page(models, own.seeds, own.episodes, sentence(made_by["command"], [made_by]))
        write_text(out.with_suffix(".md"), summary)
    return summary


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grid", choices=GRIDS, default="initialization")
    parser.add_argument("--counts", type=int, nargs="+", default=[100])
    parser.add_argument("--spec", default="specs/needle.yaml")
    parser.add_argument("--seeds", type=int, nargs="+", default=[5000, 6000])
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs/recipe"))
    printed(lambda: run(parser.parse_args()))


if __name__ == "__main__":
    main()
