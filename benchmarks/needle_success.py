"""Success and held-out log-likelihood on the needle task over training seeds (the table of SM 1.3).

    python benchmarks/needle_success.py [--seeds 5] [--episodes 200] [--jobs 2] [--set KEY=VALUE]... [--out DIR]

Every seed is a fit of ``specs/needle.yaml`` with its baselines and a rollout of all methods from the same starts.
Seeds that are done (``seed-N.json``) are not done again. Writes ``summary.json``, ``summary.md`` and ``success.png``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from ddco_pyro.evaluate import roll_out
from ddco_pyro.files import whole_file, write_text
from ddco_pyro.rollout import rate
from ddco_pyro.run import fit
from ddco_pyro.spec import load_spec

LEARNED = ("flat", "flat_equal", "per_timestep", "ddco")
ORDER = ("open_loop", *LEARNED, "supervisor")


class Silent:
    """A fit's watcher that says nothing."""

    def collected(self, done: int, total: int) -> None: ...
    def training(self, name: str, epochs: int | None) -> None: ...
    def epoch(self, row: dict[str, Any]) -> None: ...
    def trained(self, name: str) -> None: ...


def run_seed(seed: int, arguments: argparse.Namespace) -> None:
    """Fit, roll out, and keep the numbers of one training seed."""
    path = arguments.out / f"seed-{seed}.json"
    if path.exists():
        return
    overrides = [*arguments.set, f"seed={seed}"]
    if seed > 0:
        overrides.append("rollout.policies=[]")  # scripted policies know no training seed
    folder = arguments.runs / f"seed-{seed}"
    fitted = fit(load_spec("specs/needle.yaml", overrides), folder, Silent())
    results = roll_out(fitted, arguments.episodes, 0, lambda name: None, jobs=1)
    metrics = fitted.metrics
    likelihood = {name: one["log_likelihood_per_step"] for name, one in metrics["comparison"].items()}
    likelihood["ddco"] = metrics["log_likelihood_per_step"]
    training = {name: one["training"] for name, one in metrics["comparison"].items()} | {"ddco": metrics["training"]}
    kept = {
        "seed": seed,
        "overrides": arguments.set,
        "log_likelihood_per_step": likelihood,
        "difference": {name: one["difference"] for name, one in metrics["comparison"].items()},
        "training": training,
        "methods": results["methods"],
        "options": metrics["options"],
        "seconds": metrics["seconds"],
        "engine_check": metrics["engine_check"],
        "supervisor_demonstrations": metrics["demonstrations"]["supervisor"],
    }
    write_text(path, json.dumps(kept, indent=1) + "\n")


def summarize(seeds: list[dict[str, Any]]) -> dict[str, Any]:
    """Pooled counts with Wilson intervals, and means over training seeds with t intervals."""
    summary: dict[str, Any] = {}
    for name in ORDER:
        found = [one["methods"][name]["measures"] for one in seeds if name in one["methods"]]
        if not found:
            continue
        pooled = {
            measure: rate(*(sum(one[measure][part] for one in found) for part in ("successes", "trials")))
            for measure in ("success", "grasped", "inserted")
        }
        accuracy = [one["accuracy_mm"]["mean"] for one in found if one["accuracy_mm"]["trials"]]
        summary[name] = {
            **pooled,
            "success_by_seed": [one["success"]["rate"] for one in found],
            "success_over_seeds": over_seeds([one["success"]["rate"] for one in found]),
            "accuracy_mm": over_seeds(accuracy),
        }
        if name in LEARNED:
            for part in ("train", "valid"):
                values = [one["log_likelihood_per_step"][name][part] for one in seeds]
                summary[name][f"log_likelihood_{part}"] = over_seeds(values)
            summary[name]["not_converged"] = sum(not one["training"][name]["converged"] for one in seeds)
    return summary


def over_seeds(values: list[float]) -> dict[str, Any]:
    """Mean over training seeds and its 95 % t interval."""
    if len(values) < 2:
        return {"mean": values[0] if values else None, "interval": None, "seeds": len(values)}
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    mean = float(np.mean(values))
    return {"mean": mean, "interval": [mean - half, mean + half], "seeds": len(values)}


def table(summary: dict[str, Any], command: str) -> str:
    """The summary as Markdown."""
    lines = [
        f"Command: `{command}`",
        "",
        "| method | success | mean over seeds | grasped | inserted, of those | accuracy mm | held-out nats/step |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, one in summary.items():
        counts = [f"{p['successes']}/{p['trials']} [{p['interval'][0]:.0%}, {p['interval'][1]:.0%}]"
                  if p["trials"] else "-" for p in (one["success"], one["grasped"], one["inserted"])]  # fmt: skip
        cells = [name, counts[0], spread(one["success_over_seeds"], "{:.0%}"), counts[1], counts[2]]
        rising = f", {one['not_converged']} not converged" if one.get("not_converged") else ""
        cells += [spread(one["accuracy_mm"], "{:.1f}"), spread(one.get("log_likelihood_valid"), "{:.2f}") + rising]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def spread(one: dict[str, Any] | None, form: str) -> str:
    """A mean and its interval in a few characters."""
    if not one or one["mean"] is None:
        return "-"
    interval = one["interval"]
    shown = f" [{form.format(interval[0])}, {form.format(interval[1])}]" if interval else ""
    return form.format(one["mean"]) + shown


def draw(summary: dict[str, Any], path: Path) -> None:
    """Success of each method: every training seed a dot, the pooled rate and its Wilson interval a bar."""
    figure = Figure(figsize=(7, 3), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for place, one in enumerate(summary.values()):
        low, high = one["success"]["interval"]
        axes.plot([low, high], [place, place], lw=6, alpha=0.35, color="#3f6fb0", solid_capstyle="butt")
        axes.plot(one["success"]["rate"], place, "|", ms=16, mew=2, color="#1f3f70")
        axes.plot(one["success_by_seed"], [place] * len(one["success_by_seed"]), "o", ms=4, color="#1f3f70", alpha=0.7)
    axes.set(yticks=range(len(summary)), yticklabels=list(summary), xlim=(-0.02, 1.02))
    axes.set_xlabel("success rate (dots: training seeds; bar: pooled, Wilson 95 %)")
    axes.invert_yaxis()
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=Path("docs/results/needle"))
    parser.add_argument("--runs", type=Path, default=Path("runs/needle-success"))
    arguments = parser.parse_args()
    Parallel(n_jobs=arguments.jobs)(delayed(run_seed)(seed, arguments) for seed in range(arguments.seeds))
    seeds = [json.loads((arguments.out / f"seed-{seed}.json").read_text()) for seed in range(arguments.seeds)]
    summary = summarize(seeds)
    settings = "".join(f" --set '{one}'" for one in arguments.set)
    command = f"python benchmarks/needle_success.py --seeds {arguments.seeds} --episodes {arguments.episodes}{settings}"
    write_text(arguments.out / "summary.json", json.dumps(summary, indent=1) + "\n")
    write_text(arguments.out / "summary.md", table(summary, command))
    draw(summary, arguments.out / "success.png")
    print(table(summary, command))


if __name__ == "__main__":
    main()
