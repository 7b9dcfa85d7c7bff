"""Three option levels on a planted task: how well each of them is found (SM 2.3).

    python studies/planted_levels.py [--seeds 5] [--ways segments ...] [--out DIR]

A seed is a draw of demonstrations and of training. ``layer-wise`` freezes each level once it is discovered, ``joint``
goes on from the same to train all of them together, ``segments`` discovers the levels above the lowest together, from
which options of the lowest follow each other, and then trains all of them. ``limit`` and ``search`` are no ways to find
levels: with the truth's lowest level they maximise the likelihood by EM, over what the state has no part in; ``limit``
starts at the truth's own probabilities, ``search`` where ``segments`` does, from random ones. ``-320``: the same with
four times as many demonstrations.

Writes ``planted_levels.json`` after each fit, and ``planted_levels.md`` from it. Fits of the ways that are named are
not done again where the same code has made them; those of the other ways stay as they are.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from provenance import record, sentence, text
from scipy import stats
from sklearn.metrics import normalized_mutual_info_score
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))
from planted import CONTROL, TRAINING, make_spec, make_trainer, make_truth, plant, recovered

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import write_text
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

Row = dict[str, Any]
"""The ``way``, the ``seed``, what was found, and what made it."""


def one_fit(way: str, seed: int, lasting: bool = True) -> Row:
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


def interval(values: list[float]) -> str:
    """Mean and 95 % t interval."""
    half = stats.sem(values) * stats.t.ppf(0.975, len(values) - 1)
    return f"{np.mean(values):.3f} ± {half:.3f}"


def table(rows: list[Row], made_by: str) -> str:
    """The numbers as Markdown."""
    lines = [
        made_by, "",
        f"{COUNTS} options, lowest level first; {DEMONSTRATIONS} demonstrations of {STEPS} steps, {HELD_OUT} held out; "
        "mean over seeds and 95 % t interval.", "",
        "| model | seeds | held-out log-likelihood per step, nats | NMI with the true options, level 1 | level 2 "
        "| level 3 |",
        "|---|---|---|---|---|---|",
        _line("truth", list({row["seed"]: row for row in rows}.values()), "truth"),
        *(_line(way, own, "found") for way in NAMES if (own := _of(rows, way))), "",
        "| less than the truth's own, paired by seed | nats per step | NMI, level 1 | level 2 | level 3 |",
        "|---|---|---|---|---|",
        *(_short(way, own) for way in NAMES if (own := _of(rows, way))),
    ]  # fmt: skip
    for many in ("", MANY):
        best, searched = ({row["seed"]: row["fitted"] for row in _of(rows, f"{way}{many}")} for way in LIMITS)
        if seeds := sorted(best.keys() & searched.keys()):
            more = ", ".join(f"{searched[seed] - best[seed]:+.0e}" for seed in seeds)
            lines += ["", f"Training log-likelihood of search{many}, minus limit{many}, nats per step by seed: {more}."]
    return "\n".join(lines) + "\n"


def _of(rows: list[Row], way: str) -> list[Row]:
    return [row for row in rows if row["way"] == way]


def _line(name: str, rows: list[Row], model: str) -> str:
    levels = [interval(list(level)) for level in zip(*(row[f"{model} nmi"] for row in rows), strict=True)]
    seeds = ", ".join(str(row["seed"]) for row in rows)
    return f"| {name} | {seeds} | {interval([row[model] for row in rows])} | {' | '.join(levels)} |"


def _short(name: str, rows: list[Row]) -> str:
    """By how much what was found is worse than the truth."""
    short = [np.array([row["truth"], *row["truth nmi"]]) - [row["found"], *row["found nmi"]] for row in rows]
    return f"| {name} | {' | '.join(interval(list(column)) for column in zip(*short, strict=True))} |"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--ways", nargs="+", choices=NAMES, default=[*WAYS, *LIMITS])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    arguments = parser.parse_args()
    command = f"python studies/planted_levels.py --seeds {arguments.seeds} --ways {' '.join(arguments.ways)}"
    made_by, path = record(command), arguments.out / "planted_levels.json"
    before = json.loads(path.read_text())["results"] if path.exists() else []
    rows = [row for row in before if row["way"] not in arguments.ways or row["made by"]["code"] == made_by["code"]]
    done = {(row["way"], row["seed"]) for row in rows}
    cells = [(way, seed) for way in arguments.ways for seed in range(arguments.seeds) if (way, seed) not in done]
    calls = (delayed(one_fit)(way, seed) for way, seed in cells)
    for row in Parallel(n_jobs=arguments.jobs, return_as="generator_unordered")(calls):
        rows.append({**row, "made by": made_by})
        write_text(path, text(rows, [row["made by"] for row in rows]))
    rows.sort(key=lambda row: row["seed"])
    page = table(rows, sentence(made_by["command"], [row["made by"] for row in rows]))
    write_text(path.with_suffix(".md"), page)
    print(page)


if __name__ == "__main__":
    main()
