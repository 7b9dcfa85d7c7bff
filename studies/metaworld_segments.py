"""Held-out log-likelihood and agreement with the expert's phases on somebody else's demonstrations, over seeds.

    python studies/metaworld_segments.py [--seeds 5] [--set KEY=VALUE]...

Fits ``specs/metaworld_pick_place.yaml`` with each way to initialise; writes ``docs/results/metaworld.json`` and ``.md``
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fit import fit
from ddco_pyro.spec import load_spec

INITIALIZATIONS = ("random", "vq", "vq_controls")
OUT = Path("docs/results")


def run(initialize: str, seed: int, overrides: list[str]) -> dict[str, Any]:
    """One fit: its held-out log-likelihood per step and measures of its agreement with the phases."""
    changes = [*overrides, f"training.initialize={initialize}", f"seed={seed}", "compare_with=[]"]
    spec = load_spec("specs/metaworld_pick_place.yaml", changes)
    with tempfile.TemporaryDirectory() as folder:
        metrics = fit(spec, out=Path(folder) / "run").metrics.model_dump()
    return {
        "initialize": initialize,
        "seed": seed,
        "valid": metrics["log_likelihood_per_step"]["valid"],
        "agreement_train": metrics["agreement"]["train"][0],
        "agreement_valid": metrics["agreement"]["valid"][0],
    }


MEASURES = {
    "held-out nats/step": lambda row: row["valid"],
    "NMI": lambda row: row["agreement_valid"]["nmi"],
    "ARI": lambda row: row["agreement_valid"]["ari"],
    "accuracy": lambda row: row["agreement_valid"]["matched_globally"]["accuracy"],
    "F1@50": lambda row: row["agreement_valid"]["matched_globally"]["f1_50"],
    "boundary F1 ±3": lambda row: row["agreement_valid"]["boundary_f1_3"],
}


def table(rows: list[dict[str, Any]], made_by: str) -> str:
    """Mean, spread and range for each way to initialise, as Markdown."""
    lines = [
        made_by,
        "",
        "Mean ± sd (range) over seeds; agreement with the phases held out, options matched globally.",
        "",
        f"| initialise | {' | '.join(MEASURES)} |",
        "|---|" + "---|" * len(MEASURES),
    ]
    for name in INITIALIZATIONS:
        cells = []
        for measure in MEASURES.values():
            values = np.array([measure(row) for row in rows if row["initialize"] == name])
            cells.append(f"{values.mean():.2f} ± {values.std(ddof=1):.2f} ({values.min():.2f} to {values.max():.2f})")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args()
    settings = "".join(f" --set '{one}'" for one in arguments.set)
    made_by = record(f"python studies/metaworld_segments.py --seeds {arguments.seeds}{settings}")
    calls = (delayed(run)(name, s, arguments.set) for name in INITIALIZATIONS for s in range(arguments.seeds))
    rows = Parallel(n_jobs=-1)(calls)
    page = table(rows, sentence(made_by["command"], [made_by]))
    write_text(OUT / "metaworld.json", text(rows, [made_by]))
    write_text(OUT / "metaworld.md", page)
    print(page)


if __name__ == "__main__":
    main()
