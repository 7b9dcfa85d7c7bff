"""Three option levels on a planted task: how well each of them is found (SM 2.3).

    python studies/planted_levels.py [--seeds 5] [--ways segments ...] [--out DIR]

A seed is a draw of demonstrations and of training. ``layer-wise`` freezes each level once it is discovered, ``joint``
goes on from the same to train all of them together, ``segments`` discovers the levels above the lowest together, from
which options of the lowest follow each other, and then trains all of them. ``limit`` and ``search`` are no ways to find
levels: with the truth's lowest level they maximise the likelihood by EM, over what the state has no part in; ``limit``
starts at the truth's own probabilities, ``search`` where ``segments`` does, from random ones. ``-320``: the same with
four times as many demonstrations.

Adds its numbers to ``docs/results/segments.csv`` after each fit.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from cells import described
from joblib import Parallel, delayed
from sklearn.metrics import normalized_mutual_info_score
from table import RESULTS, Row, add, shown
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))
from planted import CONTROL, TRAINING, make_spec, make_trainer, make_truth, plant, recovered

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.model.batch import encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.tables import Tables
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.upper import Constants, converged, fitted

COUNTS = (4, 4, 2)
DEMONSTRATIONS, HELD_OUT, STEPS = 80, 40, 80
ENDING = -0.85  # a termination's logit: ψ = 0.3 at every level, once the levels below have ended
MANY = "-320"
"""At the end of a way's name: with four times as many demonstrations."""
WAYS = {
    "layer-wise": {"lower_levels": "frozen"},
    "joint": {"lower_levels": "fine_tuned"},
    "segments": {"lower_levels": "fine_tuned", "upper_levels": "segments"},
}

LIMITS = ("limit", "search")
NAMES = tuple(f"{way}{many}" for way in (*WAYS, *LIMITS) for many in ("", MANY))

Result = dict[str, Any]
"""The ``way``, the ``seed``, and what was found."""


def one_fit(way: str, seed: int, lasting: bool = True) -> Result:
    """A way of training on a seed's demonstrations.

    :param lasting: False: the options that are trained end after every step, at every level.
    """
    torch.set_num_threads(1)
    truth = make_truth(make_spec(COUNTS, control=CONTROL), ENDING)
    kind = way.removesuffix(MANY)
    demos, _ = plant(truth, DEMONSTRATIONS * (1 if kind == way else 4), STEPS, seed=1000 + seed)
    held_out, choices = plant(truth, HELD_OUT, STEPS, seed=2000 + seed)
    if kind in LIMITS:
        found = constants(truth, demos, held_out, choices, seed if kind == "search" else None)
    else:
        spec = make_spec(COUNTS, seed, CONTROL, **{**TRAINING, **WAYS[kind]})
        always = {f"hierarchy.levels.{number}.termination": "always" for number in range(len(COUNTS))}
        spec = spec if lasting else with_overrides(spec, always)
        with tempfile.TemporaryDirectory() as folder:
            found = recovered(make_trainer(spec, demos, Path(folder)).run(), truth, held_out, choices)
    print(way, seed, found, flush=True)
    return {"way": way, "seed": seed, **found}


def constants(
    truth: Hierarchy, demos: Demonstrations, held_out: Demonstrations, choices: Tensor, seed: int | None
) -> dict[str, Any]:
    """What the most likely constants say of demonstrations held out, and how likely they are in training, ``fitted``.

    :param seed: of the random ones that the search begins at; None where it begins at the truth.
    """
    with torch.no_grad():
        batches = [encode(part, truth.encoder, truth.scaling) for part in (demos.split(0.2, 0)[0], held_out)]
        pieces = [(truth.tabulate(batch), batch.lengths) for batch in batches]
    tables, lengths = pieces[1]
    selection = tuple(table[0, 0, :, 1:].double().exp() for table in tables.selection)
    start = Constants(selection, tuple(table[0, 0, :, 1].double().exp() for table in tables.termination[1:]))
    best = converged(pieces[:1], start) if seed is None else fitted(pieces[:1], seed)
    said = {"truth": tables, "found": best.within(tables)}
    found: dict[str, Any] = {"fitted": _per_step(best.within(pieces[0][0]), pieces[0][1])}
    for name, own in said.items():
        segments = zip(choices.unbind(-1), segment(own, lengths), strict=True)
        found[name] = _per_step(own, lengths)
        found[f"{name} nmi"] = [float(normalized_mutual_info_score(*map(Tensor.flatten, pair))) for pair in segments]
    return found


def _per_step(tables: Tables, lengths: Tensor) -> float:
    return float(log_likelihood(tables, lengths).sum()) / int(lengths.sum())


def rows_of(one: Result) -> Iterator[Row]:
    """Its numbers in the table, and those of the truth on the same demonstrations."""
    way, seed = one["way"], one["seed"]
    count = DEMONSTRATIONS * (4 if way.endswith(MANY) else 1)
    for model, method in (("found", way), ("truth", "truth")):
        yield Row("planted_levels", way, method, count, seed, "nats", one[model])
        for level, value in enumerate(one[f"{model} nmi"], 1):
            yield Row("planted_levels", way, method, count, seed, f"NMI, level {level}", value)
    if "fitted" in one:
        yield Row("planted_levels", way, way, count, seed, "nats, training", one["fitted"])


def main() -> None:
    """Measure and write."""
    parser = described(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--ways", nargs="+", choices=NAMES, default=[*WAYS, *LIMITS])
    parser.add_argument("--memoryless", action="store_true", help="options end after every step; into memory.csv")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "segments.csv")
    own = parser.parse_args()
    cells = [(way, seed) for way in own.ways for seed in range(own.seeds)]
    found = []
    work = Parallel(n_jobs=own.jobs, return_as="generator_unordered")
    for one in work(delayed(one_fit)(*cell, not own.memoryless) for cell in cells):
        rows = list(rows_of(one))
        if own.memoryless:
            rows = [row._replace(study="planted", method="mixture") for row in rows if row.method == one["way"]]
        found += rows
        add(RESULTS / "memory.csv" if own.memoryless else own.out, rows)
    print(shown(found))


if __name__ == "__main__":
    main()
