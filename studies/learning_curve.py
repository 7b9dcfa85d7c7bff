"""Cross-validated log-likelihood against the number of demonstrations (SM 1.3 figure A), and with dropout (SM 2.5).

    python studies/learning_curve.py [--spec needle] [--folds 5] [--counts 10 20 40 80] [--set KEY=VALUE]...

The demonstrations are divided into folds once. In each fold every model is trained on the first n of the others, for
every n, and scored on the fold: all models see the same demonstrations, and are scored on the same. A fit that is done
(``runs/learning_curve``) is not done again, and only complete folds count. Writes ``docs/results/learning_curve.json``,
``.md`` and ``.png``.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from provenance import Record, record, sentence, text

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.drawing.figures import blank, save, style
from ddco_pyro.evaluation.worth import paired
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.selection.folds import Folds, divide
from ddco_pyro.spec import Spec, load_spec, with_overrides
from ddco_pyro.training.data import demonstrations
from ddco_pyro.training.networks import Dimensions, baseline_spec
from ddco_pyro.training.restarts import train_model

OUT = Path("docs/results")
RUNS = Path("runs/learning_curve")
RATE = 0.5  # of dropout, as in SM 2.5
DROPOUT = {f"hierarchy.{place}.dropout": RATE for place in ("levels.0.policy", "levels.0.termination", "meta_policy")}
COLOURS = {
    "ddco": "#1f3f70",
    "ddco, dropout": "#e76300",
    "flat": "#8a8a8a",
    "flat_equal": "#c0a030",
    "per_timestep": "#3d8f5f",
}


def models(spec: Spec, dimensions: Dimensions) -> dict[str, Spec]:
    """The spec, the same with dropout, and its baselines."""
    alone = with_overrides(spec, {"compare_with": []})
    baselines = {one.kind: baseline_spec(spec, one, dimensions) for one in spec.compare_with}
    return {"ddco": alone, "ddco, dropout": with_overrides(alone, DROPOUT)} | baselines


def run(own: argparse.Namespace, made_by: Record, fold: int, folds: Folds, count: int, name: str, spec: Spec) -> None:
    """One fit, unless it is done."""
    path = RUNS / own.spec / f"{fold:02d}-{count:03d}-{name.replace(', ', '-')}.json"
    if path.exists():
        if json.loads(path.read_text())["changes"] != own.set:
            raise SystemExit(f"{path} was made with other --set; remove {RUNS}")
        return
    start = time.process_time()
    others, held_out = folds.split(fold)
    order = np.random.default_rng([spec.seed, fold]).permutation(len(others))[:count]
    used = Demonstrations(tuple(others[int(row)] for row in order))
    hierarchy = train_model(spec, folds.dimensions, used).hierarchy
    found = {
        "fold": fold,
        "count": count,
        "model": name,
        "changes": own.set,
        "made_by": made_by,
        "steps": held_out.lengths,
        "log_likelihood": Fit(spec, hierarchy).log_likelihood(held_out).tolist(),
        "cpu_seconds": time.process_time() - start,
    }
    write_text(path, json.dumps(found) + "\n")
    print(path, flush=True)


def summarize(found: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """For each model and number of demonstrations: nats per step, and the difference to ddco; errors over folds."""
    summary: dict[str, Any] = {}
    for name in names:
        summary[name] = {}
        for count in sorted({one["count"] for one in found}):
            (ours, steps), (ddco, _) = (_totals(found, model, count) for model in (name, "ddco"))
            mean = paired(ours, np.zeros(len(ours)), steps)
            summary[name][count] = {
                "log_likelihood_per_step": mean.nats_per_step,
                "standard_error": mean.standard_error,
                "minus_ddco": paired(ours, ddco, steps).model_dump(),
                "folds": (ours / steps).tolist(),
            }
    return summary


def _totals(found: list[dict[str, Any]], name: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    own = sorted((one for one in found if (one["model"], one["count"]) == (name, count)), key=lambda one: one["fold"])
    return np.array([sum(one["log_likelihood"]) for one in own]), np.array([float(sum(one["steps"])) for one in own])


def markdown(summary: dict[str, Any], folds: int, made_by: str) -> str:
    """The curves as a table."""
    counts = list(summary["ddco"])
    lines = [
        made_by,
        "",
        f"Held-out log-likelihood in nats per step, {folds} folds, the same for all models; ± is one standard error "
        "over folds. In brackets: minus ddco, paired by fold.",
        "",
        f"| demonstrations | {' | '.join(map(str, counts))} |",
        "|---|" + "---|" * len(counts),
    ]
    for name, row in summary.items():
        cells = []
        for one in row.values():
            cell = f"{one['log_likelihood_per_step']:.2f} ± {one['standard_error']:.2f}"
            difference = one["minus_ddco"]
            if name != "ddco":
                cell += f" ({difference['nats_per_step']:+.2f} ± {difference['standard_error']:.2f})"
            cells.append(cell)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(summary: dict[str, Any], path: Path) -> None:
    """Left: figure A's models. Right: with dropout and without."""
    with style():
        figure = blank(3.2)
        left, right = figure.subplots(1, 2, sharey=True)
        _lines(left, summary, [name for name in summary if "dropout" not in name])
        _lines(right, summary, ["ddco", "ddco, dropout"])
        left.set(title="Models (SM 1.3, figure A)", ylabel="held-out nats per step, ± se over folds")
        right.set(title=f"Dropout {RATE:g} (SM 2.5)")
        save(figure, path, "Cross-validated log-likelihood against the number of demonstrations", "")


def _lines(axes: Axes, summary: dict[str, Any], names: list[str]) -> None:
    for name in names:
        counts, row = list(summary[name]), list(summary[name].values())
        means, errors = ([one[key] for one in row] for key in ("log_likelihood_per_step", "standard_error"))
        axes.errorbar(counts, means, yerr=errors, marker="o", ms=4, capsize=3, color=COLOURS[name], label=name)
    axes.set(xlabel="demonstrations", xscale="log", xticks=counts, xticklabels=counts)
    axes.minorticks_off()
    axes.grid(axis="y", color="#e4e4e4")
    axes.legend(loc="lower right")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--spec", default="needle", metavar="NAME")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 20, 40, 80])
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    own = parser.parse_args()
    command = command_of(own)
    made_by = record(command)
    spec = load_spec(f"specs/{own.spec}.yaml", own.set)
    folds = divide(demonstrations(spec), own.folds, spec.seed)
    wanted = models(spec, folds.dimensions)
    for fold in range(own.folds):
        for count in own.counts:
            for name, model in wanted.items():
                run(own, made_by, fold, folds, count, name, model)
    report(own, list(wanted), command)


def command_of(own: argparse.Namespace) -> str:
    """The command that runs what was asked for."""
    settings = "".join(f" --set '{one}'" for one in own.set)
    counts = " ".join(map(str, own.counts))
    return f"python studies/learning_curve.py --spec {own.spec} --folds {own.folds} --counts {counts}{settings}"


def report(own: argparse.Namespace, names: list[str], command: str) -> None:
    """Write the results of the folds that are complete."""
    found = [json.loads(path.read_text()) for path in sorted((RUNS / own.spec).glob("*.json"))]
    fits = len(names) * len(own.counts)
    whole = [fold for fold in range(own.folds) if sum(one["fold"] == fold for one in found) == fits]
    used = [one for one in found if one["fold"] in whole]
    summary, made_by = summarize(used, names), [one.get("made_by") for one in used]
    page = markdown(summary, len(whole), sentence(command, made_by))
    write_text(OUT / "learning_curve.json", text(summary, made_by))
    write_text(OUT / "learning_curve.md", page)
    draw(summary, OUT / "learning_curve.png")
    print(page)


if __name__ == "__main__":
    main()
