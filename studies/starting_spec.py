"""Held-out log-likelihood of the spec that ``ddco-pyro init`` writes, beside the one tuned by hand, over seeds.

    python studies/starting_spec.py [--seeds 5]

Fits both on Meta-World's pick-place demonstrations; writes ``docs/results/starting_spec.json`` and ``.md``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.fitting.fit import fit
from ddco_pyro.spec import load_spec

TUNED = Path("specs/metaworld_pick_place.yaml")
OUT = Path("docs/results")


def valid(spec: Path, seed: int) -> float:
    """Held-out nats per step of one fit."""
    with tempfile.TemporaryDirectory() as folder:
        metrics = fit(load_spec(spec, [f"seed={seed}", "compare_with=[]"]), out=Path(folder) / "run").metrics
    return metrics.log_likelihood_per_step.valid


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    made_by = record(f"python studies/starting_spec.py --seeds {arguments.seeds}")
    demonstrations = load_spec(TUNED).demonstrations.path
    assert demonstrations is not None
    with tempfile.TemporaryDirectory() as folder:
        started = Path(folder) / "spec.yaml"
        started.write_text(starting_spec(inspect(demonstrations), demonstrations))
        specs = {"ddco-pyro init": started, "tuned by hand": TUNED}
        rows = {name: [valid(spec, seed) for seed in range(arguments.seeds)] for name, spec in specs.items()}
    difference = np.mean(rows["ddco-pyro init"]) - np.mean(rows["tuned by hand"])
    ratio = float(np.mean(rows["ddco-pyro init"]) / np.mean(rows["tuned by hand"]))
    lines = [
        sentence(made_by["command"], [made_by]),
        "",
        "| spec | held-out nats/step, mean ± sd (range) |",
        "|---|---|",
        *(
            f"| {name} | {np.mean(one):.2f} ± {np.std(one, ddof=1):.2f} ({min(one):.2f} to {max(one):.2f}) |"
            for name, one in rows.items()
        ),
        "",
        f"The first is {ratio:.1%} of the second (a ratio of log-densities depends on the control's unit; the",
        f"difference of {difference:+.2f} nats per step does not).",
    ]
    write_text(OUT / "starting_spec.json", text({"valid": rows, "ratio": ratio}, [made_by]))
    write_text(OUT / "starting_spec.md", "\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
