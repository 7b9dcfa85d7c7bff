"""Success on the needle task against the number of demonstrations.

    python studies/needle_curve.py [--counts 10 20 40 80] [--seeds 3] [--episodes 60] [--jobs 2] [--set KEY=VALUE]...

Trains on the first demonstrations of each training seed of ``needle_success.py``, whose results stand beside as those
with 100 where they are there, as does what was kept of other numbers. Resumable as that study is. Writes
``curve.json``, ``curve.md`` and ``curve.png``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from cells import printed
from joblib import Parallel, delayed
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from needle_success import ALL, described, differences, kept_at, run_seed, spread, summarize, words
from provenance import record, sentence, text

from ddco_pyro.data.files import whole_file, write_text

Curve = dict[str, dict[str, Any]]
"""By number of demonstrations, as a string, what :func:`needle_success.summarize` says and the paired differences."""


def page(curve: Curve, made_by: str) -> str:
    """The results as Markdown."""
    methods = [name for name, own in next(iter(curve.values()))["methods"].items() if "by_seed" in own["success"]]
    lines = [made_by, "", "Success, means over training seeds with 95 % t intervals.", ""]
    lines += [f"| demonstrations | {' | '.join(methods)} |", "|---" * (len(methods) + 1) + "|"]
    for count, found in curve.items():
        cells = [spread(found["methods"].get(name, {}).get("success"), "{:.0%}") for name in methods]
        lines.append(f"| {count} | {' | '.join(cells)} |")
    lines.append("")
    for count, found in curve.items():
        paired = [f"{name} {spread(own['success'], '{:+.0%}')}" for name, own in found["differences"].items()]
        lines.append(f"- {count} demonstrations, ddco minus each, paired by seed: {', '.join(paired)}.")
    return "\n".join(lines) + "\n"


def draw(curve: Curve, path: Path) -> None:
    """A line for each method: the mean, training seeds as dots, the interval as a bar."""
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    counts = [int(count) for count in curve]
    names = [name for name, own in next(iter(curve.values()))["methods"].items() if "by_seed" in own["success"]]
    for number, name in enumerate(names):
        rates = [found["methods"][name]["success"] for found in curve.values()]
        shifted = [count * 1.02 ** (number - len(names) / 2) for count in counts]
        axes.plot(shifted, [rate["mean"] for rate in rates], "-", color=f"C{number}", label=name)
        for place, rate in zip(shifted, rates, strict=True):
            axes.plot([place] * len(rate["by_seed"]), rate["by_seed"], "o", ms=3, color=f"C{number}", alpha=0.7)
            if rate["interval"]:
                axes.plot([place, place], rate["interval"], lw=4, alpha=0.25, color=f"C{number}")
    axes.set(xscale="log", xlabel="demonstrations", ylabel="success rate", ylim=(-0.02, 1.02))
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.legend(fontsize=8)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def run() -> str:
    """Do what is not done yet, and write what comes of it; the page."""
    parser = described(__doc__, seeds=3, episodes=60)
    parser.add_argument("--counts", type=int, nargs="+", default=[10, 20, 40, 80])
    arguments = parser.parse_args()
    command = f"python studies/needle_curve.py --counts {' '.join(map(str, arguments.counts))} {words(arguments)}"
    made_by = record(command)
    cells = [(seed, count) for count in arguments.counts for seed in range(arguments.seeds)]
    Parallel(n_jobs=arguments.jobs)(delayed(run_seed)(*cell, arguments, made_by) for cell in cells)
    curve, records = {}, []
    others = {int(path.name.split("-")[1]) for path in arguments.out.glob("count-*-seed-*.json")}
    for count in sorted({*arguments.counts, *others, ALL}):
        paths = [kept_at(arguments.out, seed, count) for seed in range(arguments.seeds)]
        kept = [json.loads(path.read_text()) for path in paths if path.exists()]
        if kept:
            seeds = [one["results"] for one in kept]
            curve[str(count)] = {"methods": summarize(seeds), "differences": differences(seeds)}
            records += [one for each in kept for one in each["provenance"]]
    summary = page(curve, sentence(command, records))
    write_text(arguments.out / "curve.json", text(curve, records))
    write_text(arguments.out / "curve.md", summary)
    draw(curve, arguments.out / "curve.png")
    return summary


def main() -> None:
    """Run the study."""
    printed(run)


if __name__ == "__main__":
    main()
