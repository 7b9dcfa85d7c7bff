"""What the kind of emission and a σ for each option change on somebody else's demonstrations, over seeds.

    python studies/emission_kinds.py [--seeds 5] [--spec specs/metaworld_pick_place.yaml] [--set KEY=VALUE] [--out FILE]

Fits the spec with each variant; writes ``docs/results/emission_kinds.json`` and ``.md``, or those of ``--out``. Cells
that the JSON has already, made by the same code, are not done again. Log-likelihoods of different kinds measure
different things and are not compared; how well the options agree with the labelled phases can be.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fit import fit
from ddco_pyro.spec import load_spec

SPEC = "specs/metaworld_pick_place.yaml"
NETWORKS = {"linear": "{network: linear}", "perceptron": "{network: mlp, hidden: [32]}"}
OWN = {"one for all options": "{learn: true}", "one for each": "{learn: true, per_option: true}"}
VARIANTS = [(kind, network, own) for kind in ("gaussian", "auto") for network in NETWORKS for own in OWN]
OUT = Path("docs/results/emission_kinds")


def run(spec: str, own_changes: list[str], variant: tuple[str, str, str], seed: int) -> dict[str, Any]:
    """One fit: its held-out log-likelihood per step, its agreement with the phases, and what was decided."""
    kind, network, own = variant
    changes = [
        f"control.kind={kind}", f"control.std={OWN[own]}", f"hierarchy.levels.0.policy={NETWORKS[network]}",
        f"seed={seed}", "compare_with=[]", *own_changes,
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        metrics = fit(load_spec(spec, changes), out=Path(folder) / "run").metrics.model_dump()
    return {
        "kind": kind,
        "network": network,
        "sigma": own,
        "seed": seed,
        "measure": metrics["measure"],
        "valid": metrics["log_likelihood_per_step"]["valid"],
        "agreement_valid": metrics["agreement"]["valid"][0],
        "converged": metrics["training"]["converged"],
        "seconds": metrics["seconds"]["training"],
    }


def table(rows: list[dict[str, Any]], made_by: str) -> str:
    """Mean, spread and range for each variant, as Markdown."""
    lines = [
        made_by,
        "",
        "Held-out nats per step are densities for `gaussian`; for `auto`, masses on the bounds and densities within. "
        "Between kinds they are not to be compared.",
        "",
        "| kind | decided | options | σ | NMI with the phases, held out: mean ± sd (range) | accuracy | nats/step |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, network, own in VARIANTS:
        cell = [row for row in rows if (row["kind"], row["network"], row["sigma"]) == (kind, network, own)]
        if cell:
            decided = ", ".join(dict.fromkeys(each[0] for each in cell[0]["measure"].values()))
            nmi = _spread([row["agreement_valid"]["nmi"] for row in cell])
            accuracy = _spread([row["agreement_valid"]["matched_globally"]["accuracy"] for row in cell])
            valid = _spread([row["valid"] for row in cell])
            lines.append(f"| {kind} | {decided} | {network} | {own} | {nmi} | {accuracy} | {valid} |")
    return "\n".join(lines) + "\n"


def _spread(values: list[float]) -> str:
    array = np.array(values)
    spread = f" ± {array.std(ddof=1):.2f}" if len(array) > 1 else ""
    return f"{array.mean():.2f}{spread} ({array.min():.2f} to {array.max():.2f})"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--spec", default=SPEC)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, default=OUT, help="The results' path, without an ending.")
    parser.add_argument("--jobs", type=int, default=-1)
    arguments = parser.parse_args()
    command = f"python studies/emission_kinds.py --seeds {arguments.seeds} --spec {arguments.spec}"
    command += "".join(f" --set '{change}'" for change in arguments.set)
    made_by, page = record(command), arguments.out.with_suffix(".json")
    kept = json.loads(page.read_text()) if page.exists() else {}
    same = bool(kept) and kept["provenance"][0]["code"] == made_by["code"]
    rows = kept["results"] if same else []
    done = {(row["kind"], row["network"], row["sigma"], row["seed"]) for row in rows}
    cells = [(variant, seed) for seed in range(arguments.seeds) for variant in VARIANTS if (*variant, seed) not in done]
    calls = (delayed(run)(arguments.spec, arguments.set, variant, seed) for variant, seed in cells)
    for row in Parallel(n_jobs=arguments.jobs, return_as="generator_unordered")(calls):
        rows.append(row)
        write_text(page, text(rows, [made_by]))
    write_text(arguments.out.with_suffix(".md"), table(rows, sentence(made_by["command"], [made_by])))
    print(arguments.out.with_suffix(".md").read_text())


if __name__ == "__main__":
    main()
