"""Bin picking as the paper evaluates it: bins cleared, single grasps, recovery and categorisation of each method.

    python studies/bin_picking.py [--seeds 3] [--specs bin_picking bin_picking_hybrid] [--bins 20] [--jobs 1]
        [--set KEY=VALUE]... [--summarize]

A cell is a spec fitted under a training seed, with what it compares itself with, and rolled out on as many bins; it is
kept once it is done. All cells have the same demonstrations, each training seed bins of its own. ``--summarize`` runs
nothing. Writes ``summary.json`` and ``summary.md`` of all cells that are done.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rates
from cells import Cell, Settings, printed, some
from joblib import Parallel, delayed
from needle_success import over_seeds, spread
from provenance import record, sentence, text
from scipy import stats

from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.simulation.episodes import rate
from ddco_pyro.spec import load_spec

SPECS = {"bin_picking": "specs/bin_picking.yaml", "bin_picking_hybrid": "specs/bin_picking_hybrid.yaml"}
OURS = "DDCO"
NAMES = {"bin_picking": OURS, "bin_picking_hybrid": "hybrid"}
STARTS = 950_000
"""Seed of the first training seed's first bin."""
DEFAULTS = Settings({"bins": 20}, Path("runs/bin-picking"))
PAPER = {"bins cleared": "70 % of 10", "grasp of exactly one": "66 % of 99", "recovery, recall": "97 % of 34",
         "categorisation": "98 %"}  # fmt: skip
FAILURES = ("empty", "several", "slipped", "wrong cup", "not let go")

Bin = Mapping[str, float]
"""The measures of a bin, by name."""


@dataclass(frozen=True)
class Fitted(Cell):
    """A spec under a training seed."""

    script = "bin_picking.py"
    spec: str
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """The bins of every method, and how long fit and rollouts took."""
        changes = ["compare_with=[]"] if self.spec == "bin_picking_hybrid" else []
        return evaluated(SPECS[self.spec], self.seed, changes, NAMES[self.spec], settings, folder)


def evaluated(
    spec: str, seed: int, changes: Sequence[str], called: str, settings: Settings, folder: Path
) -> dict[str, Any]:
    """The bins of every method of a spec with some changes, fitted under a training seed, and the seconds of it.

    :param called: the name of the spec's own model.
    """
    own = [f"seed={seed}", f"rollout.seed={STARTS + 1000 * seed}", "rollout.policies=[]"]
    begun = time.perf_counter()
    fitted = fit(load_spec(spec, [*own, *changes, *settings.overrides]), out=folder)
    trained = time.perf_counter()
    roll_out(fitted, int(settings.values["bins"]), jobs=1)
    seconds = {"fit": trained - begun, "rollouts": time.perf_counter() - trained}
    return {"methods": _methods(called, fitted), "seconds": seconds}


def _methods(called: str, fitted: Fit) -> dict[str, Any]:
    """The bins of each method by name, with its held-out likelihood where it was fitted."""
    models = {fitted.name: fitted.metrics} | fitted.metrics.comparison
    found: dict[str, Any] = {}
    with (fitted.run_folder / "rollouts.csv").open(encoding="utf-8", newline="") as table:
        for row in csv.DictReader(table):
            name = row.pop("method")
            own = found.setdefault(called if name == fitted.name else name, {"bins": []})
            own["bins"].append({key: float(value) for key, value in row.items()})
            if name in models:
                own["log_likelihood_per_step"] = models[name].log_likelihood_per_step.model_dump()
    return found


def clustered(bins: Sequence[Bin], of: str, among: str) -> dict[str, Any]:
    """A rate of counts that are pooled over bins: Wilson's 95 % interval for the number of independent trials that
    gives the variance between bins (at most as many as there are).
    """
    counts, trials = (np.array([one[name] for one in bins]) for name in (of, among))
    found = rate(int(counts.sum()), int(trials.sum()))
    if not found["trials"] or found["rate"] in (0.0, 1.0) or len(bins) < 2:
        return found
    share, total = found["rate"], trials.sum()
    variance = len(bins) / (len(bins) - 1) * np.sum((counts - share * trials) ** 2) / total**2
    independent = min(total, share * (1 - share) / variance)
    found["interval"] = wilson(share, independent)
    return found


def wilson(share: float, trials: float) -> list[float]:
    """Wilson's 95 % interval of a share among a number of trials, which need not be whole."""
    z = float(stats.norm.ppf(0.975))
    centre, width = share + z**2 / (2 * trials), z * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return [float((centre + sign * width) / (1 + z**2 / trials)) for sign in (-1, 1)]


def measured(bins: Sequence[Bin]) -> dict[str, Any]:
    """The paper's criteria, and what went wrong."""
    more = [
        {
            **one,
            "opened over the bin": one["recovered"] + one["due_cups"] - one["kept"],
            "several held": one["due_recoveries"] - one["nothing"],
            "several recovered": one["recovered"] - one["nothing_recovered"],
            "wrong cup": one["delivered"] - one["sorted"],
            "not let go": one["attempts"] - one["due_cups"] - one["due_recoveries"],
        }
        for one in bins
    ]
    criteria = {
        "bins cleared": rate(int(sum(one["cleared"] for one in bins)), len(bins)),
        "bins cleared into the right cups": rate(int(sum(one["success"] for one in bins)), len(bins)),
        "grasp of exactly one": clustered(more, "single", "attempts"),
        "recovery, recall": clustered(more, "recovered", "due_recoveries"),
        "recall where nothing is held": clustered(more, "nothing_recovered", "nothing"),
        "recall where several are": clustered(more, "several recovered", "several held"),
        "recovery, precision": clustered(more, "recovered", "opened over the bin"),
        "categorisation": clustered(more, "sorted", "delivered"),
    }
    failures = {name: int(sum(one[name] for one in more)) for name in FAILURES}
    ends = {name.removeprefix("ended_"): int(sum(one[name] for one in bins)) for name in bins[0] if "ended" in name}
    share = sum(one["delivered"] for one in bins) / sum(one["objects"] for one in bins)
    return {"criteria": criteria, "failures": failures, "ends": ends, "delivered": share}


def summarize(cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Every method over all training seeds, and what :func:`paired` says of it."""
    bins: dict[str, list[Bin]] = {}
    by_seed: dict[str, list[int]] = {}
    likelihoods: dict[str, list[float]] = {}
    for cell in cells:
        for name, one in cell["methods"].items():
            bins.setdefault(name, []).extend(one["bins"])
            by_seed.setdefault(name, []).append(int(sum(each["cleared"] for each in one["bins"])))
            if "log_likelihood_per_step" in one:
                likelihoods.setdefault(name, []).append(one["log_likelihood_per_step"]["valid"])
    return {
        name: measured(one)
        | {"held_out": likelihoods.get(name, []), "cleared by seed": by_seed[name], "paired": paired(by_seed, name)}
        for name, one in bins.items()
    }


def paired(by_seed: Mapping[str, Sequence[int]], name: str) -> dict[str, Any] | None:
    """How many more bins DDCO cleared than another method, over training seeds; None where seeds are not the same.

    Bins of one fit tell of one fit: what differs between methods is told by the spread over fits.
    """
    ours, theirs = (by_seed.get(method, []) for method in (OURS, name))
    if name == OURS or len(ours) != len(theirs):
        return None
    return over_seeds([more - less for more, less in zip(ours, theirs, strict=True)])


def beside(found: Mapping[str, Any] | None) -> str:
    """What :func:`paired` says, as the page has it."""
    if found is None:
        return "-"
    return f"{', '.join(format(one, '+d') for one in found['by_seed'])}: {spread(dict(found), '{:+.1f}')}"


def page(summary: Mapping[str, Any], seconds: Sequence[Mapping[str, float]], made_by: str) -> str:
    """The results as Markdown."""
    criteria = list(next(iter(summary.values()))["criteria"])
    lines = [made_by, "", f"| | {' | '.join(summary)} | paper |", "|---" * (len(summary) + 2) + "|"]
    for name in criteria:
        cells = [rates.shown(one["criteria"][name]) for one in summary.values()]
        lines.append(f"| {name} | {' | '.join(cells)} | {PAPER.get(name, '-')} |")
    cells = [", ".join(map(str, one["cleared by seed"])) for one in summary.values()]
    lines.append(f"| bins cleared, by seed | {' | '.join(cells)} | - |")
    cells = [beside(one["paired"]) for one in summary.values()]
    lines.append(f"| bins cleared by {OURS} minus this, by seed | {' | '.join(cells)} | - |")
    cells = [f"{one['delivered']:.0%}" for one in summary.values()]
    lines.append(f"| objects brought into cups | {' | '.join(cells)} | - |")
    cells = [", ".join(f"{value:.2f}" for value in one["held_out"]) or "-" for one in summary.values()]
    lines.append(f"| held-out nats per step, by seed | {' | '.join(cells)} | - |")
    for part in ("failures", "ends"):
        for name in next(iter(summary.values()))[part]:
            lines.append(f"| {name} | {' | '.join(str(one[part][name]) for one in summary.values())} | - |")
    fits, rolled = ([one[part] for one in seconds] for part in ("fit", "rollouts"))
    lines += [
        "",
        "Rates with 95 % Wilson intervals; where counts of a bin are pooled, for as many independent trials as the "
        "variance between bins gives. Differences are of bins that the same seed cleared, with their mean and its 95 % "
        "t interval over seeds. "
        "Below: how many attempts were empty, took several, lost some of what they had "
        "lifted, ended in the wrong cup, or were over before the jaws opened; then how bins ended that were not "
        "cleared.",
        f"A cell took {np.mean(fits):.0f} s to fit and {np.mean(rolled):.0f} s to roll out, on one thread.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--specs", nargs="+", choices=list(SPECS), default=list(SPECS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--summarize", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("docs/results/bin_picking"))
    DEFAULTS.add_to(parser)
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Do what is not done yet, and write what all cells that are done say together; the page."""
    settings = DEFAULTS.given(own)
    cells = some([Fitted(spec, seed) for seed in range(own.seeds) for spec in own.specs])
    command = f"python studies/bin_picking.py --seeds {own.seeds} --specs {' '.join(own.specs)} {settings.words()}"
    if not own.summarize:
        made_by = record(cells[0].command(settings))
        Parallel(n_jobs=own.jobs)(delayed(cell.run)(settings, made_by) for cell in cells)
    kept = [json.loads(path.read_text()) for cell in cells if (path := cell.path(settings)).exists()]
    summary = summarize([one["results"] for one in kept])
    records = [one["provenance"][0] for one in kept]
    shown = page(summary, [one["results"]["seconds"] for one in kept], sentence(command, records))
    write_text(own.out / "summary.json", text(summary, records))
    write_text(own.out / "summary.md", shown)
    return shown


if __name__ == "__main__":
    main()
