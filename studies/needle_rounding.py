"""How much success on the needle task depends on rounding: fits whose inputs differ by 1e-7 of their spread.

    python studies/needle_rounding.py [--seeds 2] [--draws 4] [--episodes 100] [--jobs 2] [--out DIR] [--runs DIR]

Another processor rounds otherwise, from the first gradient step on; so does the same one when the observations of the
demonstrations are changed by noise that float32 can hardly tell. Fits the specs of the hierarchy and of the flat policy
to the demonstrations of each training seed of ``needle_success.py`` under several draws of the noise, rolled out from
the same starts. What this code has done is not done again. Writes ``rounding.json`` and ``rounding.md``.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cells import described, kept
from joblib import Parallel, delayed
from needle_success import APART, DEMONSTRATIONS, FITS, STARTS
from provenance import Record, record, sentence, text

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import demonstrations

METHODS = ("ddco", "flat")
NOISE = 1e-7
"""In parts of an observation's standard deviation over all demonstrations; draw 0 has none."""

Result = dict[str, Any]


def disturbed(demos: Demonstrations, draw: int) -> Demonstrations:
    """The demonstrations with noise on their observations."""
    if draw == 0:
        return demos
    random = np.random.default_rng(draw)
    spread = {
        key: np.concatenate([demo.observations[key] for demo in demos]).std(0) for key in demos.observation_shapes
    }

    def changed() -> Iterator[Any]:
        for demo in demos:
            noise = {key: NOISE * spread[key] * random.standard_normal(seen.shape)
                     for key, seen in demo.observations.items()}  # fmt: skip
            yield replace(demo, observations={key: seen + noise[key] for key, seen in demo.observations.items()})

    return replace(demos, demonstrations=tuple(changed()))


def run(method: str, seed: int, draw: int, arguments: argparse.Namespace, made_by: Record) -> Result:
    """Fit, roll out, and keep how often it succeeded and how likely held-out demonstrations are."""
    named = {"method": method, "seed": seed, "draw": draw, "episodes": arguments.episodes}
    name = f"{method}-{seed}-{draw}"

    def results() -> Result:
        own = [f"seed={seed}", f"demonstrations.seed={DEMONSTRATIONS + APART * seed}", f"rollout.seed={STARTS}"]
        spec = load_spec(FITS[method][0], [*own, "compare_with=[]", "rollout.policies=[]"])
        with one_thread():
            fitted = fit(spec, disturbed(demonstrations(spec), draw), out=arguments.runs / made_by["code"][:12] / name)
            rolled = roll_out(fitted, arguments.episodes, jobs=1)
        success = rolled.success_rates[fitted.name]
        valid = fitted.metrics.log_likelihood_per_step.valid
        return {"successes": success.successes, "trials": success.trials, "log_likelihood_valid": valid}

    return kept(arguments.runs / "cells" / f"{name}.json", named, made_by, results)["results"]


def summarize(rows: list[Result]) -> Result:
    """For each method and seed the rates of all draws, their range, and their standard deviation."""
    found: Result = {}
    for method, seed in sorted({(row["method"], row["seed"]) for row in rows}):
        own = sorted((row for row in rows if (row["method"], row["seed"]) == (method, seed)), key=lambda r: r["draw"])
        rates = [row["successes"] / row["trials"] for row in own]
        likelihoods = [row["log_likelihood_valid"] for row in own]
        found.setdefault(method, {})[str(seed)] = {
            "rates": rates,
            "range": max(rates) - min(rates),
            "sd": float(np.std(rates, ddof=1)) if len(rates) > 1 else None,
            "by_chance": float(np.sqrt(np.mean(rates) * (1 - np.mean(rates)) / own[0]["trials"])),
            "log_likelihood_valid": likelihoods,
        }
    return found


def page(summary: Result, made_by: str) -> str:
    """The results as Markdown."""
    lines = [
        made_by,
        "",
        f"Success where the observations of the demonstrations have noise of {NOISE:g} of their spread (draw 0: none). "
        "The standard deviation over draws stands beside that of as many independent episodes of a single policy: the "
        "starts are the same for all draws, so without any difference between policies it would be 0.",
        "",
        "| method | seed | success by draw | range | sd | sd of episodes | nats/step held out by draw |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, seeds in summary.items():
        for seed, one in seeds.items():
            rates = ", ".join(f"{rate:.0%}" for rate in one["rates"])
            likelihoods = ", ".join(f"{value:.2f}" for value in one["log_likelihood_valid"])
            sd = "-" if one["sd"] is None else f"{one['sd']:.1%}"
            cells = [method, seed, rates, f"{one['range']:.0%}", sd, f"{one['by_chance']:.1%}", likelihoods]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/results/needle"))
    parser.add_argument("--runs", type=Path, default=Path("runs/needle-rounding"))
    own = parser.parse_args()
    words = f"--seeds {own.seeds} --draws {own.draws} --episodes {own.episodes}"
    made_by = record(f"python studies/needle_rounding.py {words}")
    cells = list(itertools.product(METHODS, range(own.seeds), range(own.draws)))
    rows = Parallel(n_jobs=own.jobs)(delayed(run)(*cell, own, made_by) for cell in cells)
    named = [
        dict(zip(("method", "seed", "draw"), cell, strict=True)) | row for cell, row in zip(cells, rows, strict=True)
    ]
    summary = summarize(named)
    write_text(own.out / "rounding.json", text(summary, [made_by]))
    write_text(own.out / "rounding.md", page(summary, sentence(made_by["command"], [made_by])))


if __name__ == "__main__":
    main()
