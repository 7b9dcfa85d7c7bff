"""Success on the needle task against the number of demonstrations.

    python studies/needle_curve.py [--counts 10 20 40 80] [--clock] [--seeds 3] [--episodes 60]
        [--fits NAME ...] [--jobs 2] [--set KEY=VALUE]... [--summarize]

Trains on the first demonstrations of each training seed of ``needle_success.py``, whose results stand beside as those
with 100 where they are there, as does what was kept of other numbers. With ``--clock`` it is the policies that are told
the time step. Resumable as that study is. Writes ``curve.json``, ``curve.md`` and ``curve.png``.
"""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

from cells import printed, some
from joblib import Parallel, delayed
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from needle_success import (
    ALL,
    CLOCKED,
    OURS,
    Seed,
    described,
    differences,
    kept_at,
    run_seed,
    spread,
    summarize,
    words,
)
from provenance import Record, record, sentence, text

from ddco_pyro.data.files import whole_file, write_text

Curve = dict[str, dict[str, Any]]
"""By number of demonstrations, as a string, what :func:`needle_success.summarize` says and the paired differences."""

COMPARED = (OURS, CLOCKED[0])
"""The methods that every other one is compared with."""


def page(curve: Curve, made_by: str) -> str:
    """The results as Markdown."""
    methods = names(curve)
    lines = [made_by, "", "Success, means over training seeds with 95 % t intervals.", ""]
    lines += [f"| demonstrations | {' | '.join(methods)} |", "|---" * (len(methods) + 1) + "|"]
    for count, found in curve.items():
        cells = [spread(found["methods"].get(name, {}).get("success"), "{:.0%}") for name in methods]
        lines.append(f"| {count} | {' | '.join(cells)} |")
    lines.append("")
    for ours, (count, found) in product(COMPARED, curve.items()):
        if own := found["differences"].get(ours):
            paired = [f"{name} {spread(other['success'], '{:+.0%}')}" for name, other in own.items()]
            lines.append(f"- {count} demonstrations, {ours} minus each, paired by seed: {', '.join(paired)}.")
    return "\n".join(lines) + "\n"


def names(curve: Curve) -> list[str]:
    """The methods that are trained, with any number of demonstrations."""
    trained = (
        name for found in curve.values() for name, own in found["methods"].items() if "by_seed" in own["success"]
    )
    return list(dict.fromkeys(trained))


def draw(curve: Curve, path: Path) -> None:
    """A line for each method: the mean, training seeds as dots, the interval as a bar."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    methods = names(curve)
    for number, name in enumerate(methods):
        having = {int(count): found["methods"][name] for count, found in curve.items() if name in found["methods"]}
        rates = [own["success"] for own in having.values()]
        shifted = [count * 1.02 ** (number - len(methods) / 2) for count in having]
        axes.plot(shifted, [rate["mean"] for rate in rates], "-", color=f"C{number}", label=name)
        for place, rate in zip(shifted, rates, strict=True):
            axes.plot([place] * len(rate["by_seed"]), rate["by_seed"], "o", ms=3, color=f"C{number}", alpha=0.7)
            if rate["interval"]:
                axes.plot([place, place], rate["interval"], lw=4, alpha=0.25, color=f"C{number}")
    axes.set(xscale="log", xlabel="demonstrations", ylabel="success rate", ylim=(-0.02, 1.02))
    axes.set_xticks([int(count) for count in curve], list(curve))
    axes.minorticks_off()
    figure.legend(fontsize=8, loc="outside right upper")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def run() -> str:
    """Do what is not done yet, and write what comes of it; the page."""
    parser = described(__doc__, seeds=3, episodes=60)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 20, 40, 80])
    parser.add_argument("--clock", action="store_true", help="fit the policies that are told the time step")
    parser.add_argument("--summarize", action="store_true", help="do nothing that is not done")
    arguments = parser.parse_args()
    command = f"python studies/needle_curve.py --counts {' '.join(map(str, arguments.counts))} "
    command += f"{'--clock ' * arguments.clock}{words(arguments)}"
    made_by = record(command)
    cells = some([(seed, count) for count in arguments.counts for seed in range(arguments.seeds)])
    if not arguments.summarize:
        Parallel(n_jobs=arguments.jobs)(delayed(run_seed)(*cell, arguments, made_by, arguments.clock) for cell in cells)
    kept = {count: _kept(arguments.out, count, arguments.seeds) for count in _counts(arguments.out)}
    curve = {
        str(count): {
            "methods": summarize(seeds),
            "differences": {ours: differences(seeds, ours) for ours in COMPARED if ours in seeds[0]["methods"]},
        }
        for count, (seeds, _) in kept.items()
    }
    records = [one for _, each in kept.values() for one in each]
    summary = page(curve, sentence(command, records))
    write_text(arguments.out / "curve.json", text(curve, records))
    write_text(arguments.out / "curve.md", summary)
    draw(curve, arguments.out / "curve.png")
    return summary


def _counts(folder: Path) -> list[int]:
    """The numbers of demonstrations that anything is kept of."""
    return sorted({ALL, *(int(path.name.split("-")[1]) for path in folder.glob("count-*-seed-*.json"))})


def _kept(folder: Path, count: int, most: int) -> tuple[list[Seed], list[Record]]:
    """Of each training seed what is kept with so many demonstrations, with and without the time step, and the records
    of all.
    """
    seeds, records = [], []
    for seed in range(most):
        paths = dict.fromkeys(kept_at(folder, seed, count, clocked) for clocked in (False, True))
        contents = [json.loads(path.read_text()) for path in paths if path.exists()]
        if contents:
            seeds.append(joined([content["results"] for content in contents]))
            records += [one for content in contents for one in content["provenance"]]
    return seeds, records


def joined(parts: list[Seed]) -> Seed:
    """What is kept of one training seed in several files: by part, what there is of every method."""
    whole: Seed = {}
    for part in parts:
        for key, value in part.items():
            whole[key] = {**whole.get(key, {}), **value} if isinstance(value, dict) else value
    return whole


def main() -> None:
    """Run the study."""
    printed(run)


if __name__ == "__main__":
    main()
