"""Three option levels on a planted task: found level by level, then fine-tuned together (SM 2.3).

    python studies/planted_levels.py [--seeds 5] [--out DIR]

A seed is a draw of demonstrations and of training; ``layer-wise`` freezes each level once it is discovered, ``joint``
goes on from the same to train all of them together. Writes ``planted_levels.json`` and ``planted_levels.md``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from provenance import record, sentence, text
from scipy import stats

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))
from planted import CONTROL, TRAINING, make_spec, make_trainer, make_truth, plant, recovered

from ddco_pyro.data.files import write_text

COUNTS = (4, 4, 2)
DEMONSTRATIONS, HELD_OUT, STEPS = 80, 40, 80
ENDING = -0.85  # a termination's logit: ψ = 0.3 at every level, once the levels below have ended
WAYS = {"layer-wise": "frozen", "joint": "fine_tuned"}


def one_seed(seed: int) -> dict[str, Any]:
    """Both ways of training on the same demonstrations."""
    torch.set_num_threads(1)
    truth, found = make_truth(make_spec(COUNTS, control=CONTROL), ENDING), {}
    demos, _ = plant(truth, DEMONSTRATIONS, STEPS, seed=1000 + seed)
    held_out, choices = plant(truth, HELD_OUT, STEPS, seed=2000 + seed)
    for way, lower in WAYS.items():
        spec = make_spec(COUNTS, seed, CONTROL, **{**TRAINING, "lower_levels": lower})
        with tempfile.TemporaryDirectory() as folder:
            found[way] = recovered(make_trainer(spec, demos, Path(folder)).run(), truth, held_out, choices)
    print(seed, found, flush=True)
    return found


def interval(values: list[float]) -> str:
    """Mean and 95 % t interval."""
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return f"{np.mean(values):.3f} ± {half:.3f}"


def table(rows: list[dict[str, Any]], made_by: str) -> str:
    """The numbers as Markdown."""
    lines = [
        made_by, "",
        f"{COUNTS} options, lowest level first; {DEMONSTRATIONS} demonstrations of {STEPS} steps, {HELD_OUT} held out; "
        f"{len(rows)} seeds, mean and 95 % t interval.", "",
        "| model | held-out log-likelihood per step, nats | NMI with the true options, level 1 | level 2 | level 3 |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    models = {"truth": [row["joint"]["truth"] for row in rows]}
    agreement = {"truth": [row["joint"]["truth nmi"] for row in rows]}
    for way in WAYS:
        models[way] = [row[way]["found"] for row in rows]
        agreement[way] = [row[way]["found nmi"] for row in rows]
    for name, values in models.items():
        levels = [interval(list(level)) for level in zip(*agreement[name], strict=True)]
        lines.append(f"| {name} | {interval(values)} | {' | '.join(levels)} |")
    gain = [row["joint"]["found"] - row["layer-wise"]["found"] for row in rows]
    lines += ["", f"Joint fine-tuning adds {interval(gain)} nats per step, paired by seed."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    arguments = parser.parse_args()
    made_by = record(f"python studies/planted_levels.py --seeds {arguments.seeds}")
    rows = Parallel(n_jobs=arguments.jobs)(delayed(one_seed)(seed) for seed in range(arguments.seeds))
    page = table(rows, sentence(made_by["command"], [made_by]))
    write_text(arguments.out / "planted_levels.json", text(rows, [made_by]))
    write_text(arguments.out / "planted_levels.md", page)
    print(page)


if __name__ == "__main__":
    main()
