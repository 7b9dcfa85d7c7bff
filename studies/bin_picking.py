"""Bin picking as the paper evaluates it: bins cleared, single grasps, recovery and categorisation of each method.

    python studies/bin_picking.py [--seeds 5] [--specs bin_picking bin_picking_hybrid] [--bins 20] [--jobs 1]
        [--set KEY=VALUE]... [--summarize]

A cell is a spec fitted under a training seed, with what it compares itself with, and rolled out on as many bins. All
cells have the same demonstrations, each training seed bins of its own. A cell that was done with these settings is not
done again. Adds its numbers to ``docs/results/bin_picking.csv``.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import study
from study import Cell, Row, Settings, described

from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.rollouts import roll_out
from ddco_pyro.spec import load_spec

SPECS = {"bin_picking": "specs/bin_picking.yaml", "bin_picking_hybrid": "specs/bin_picking_hybrid.yaml"}
OURS = "DDCO"
NAMES = {"bin_picking": OURS, "bin_picking_hybrid": "hybrid"}
STARTS = 950_000
"""Seed of the first training seed's first bin."""
DEMONSTRATIONS = 60  # of the specs
DEFAULTS = Settings({"bins": 20}, Path("runs/bin-picking"))
FAILURES = ("empty", "several", "slipped", "wrong cup", "not let go")

Bin = Mapping[str, float]
"""The measures of a bin, by name."""


@dataclass(frozen=True)
class Fitted(Cell):
    """A spec under a training seed."""

    spec: str
    seed: int

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """The bins of every method, and how long fit and rollouts took."""
        changes = ["compare_with=[]"] if self.spec == "bin_picking_hybrid" else []
        return evaluated(SPECS[self.spec], self.seed, changes, NAMES[self.spec], settings, folder)

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """The paper's criteria, each as a share of its trials, and how many trials it has."""
        for method, own in results["methods"].items():
            named = self.spec, "bins", method, DEMONSTRATIONS, self.seed
            yield Row(*named, "nats", own["log_likelihood_per_step"]["valid"])
            for measure, (count, among) in criteria(own["bins"]).items():
                if among:
                    yield Row(*named, measure, count / among)
                    yield Row(*named, f"{measure}, trials", among)


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


def criteria(bins: Sequence[Bin]) -> dict[str, tuple[float, float]]:
    """The paper's criteria, and what went wrong: how often, and of how many bins, attempts, loads or objects."""
    sums = {name: sum(one[name] for one in bins) for name in bins[0]}
    opened = sums["recovered"] + sums["due_cups"] - sums["kept"]
    several = sums["due_recoveries"] - sums["nothing"]
    failed = {name: sums[name] for name in FAILURES[:3]}
    failed["wrong cup"] = sums["delivered"] - sums["sorted"]
    failed["not let go"] = sums["attempts"] - sums["due_cups"] - sums["due_recoveries"]
    return {
        "success": (sums["cleared"], len(bins)),
        "bins cleared into the right cups": (sums["success"], len(bins)),
        "grasp of exactly one": (sums["single"], sums["attempts"]),
        "recovery, recall": (sums["recovered"], sums["due_recoveries"]),
        "recall where nothing is held": (sums["nothing_recovered"], sums["nothing"]),
        "recall where several are": (sums["recovered"] - sums["nothing_recovered"], several),
        "recovery, precision": (sums["recovered"], opened),
        "categorisation": (sums["sorted"], sums["delivered"]),
        "objects brought into cups": (sums["delivered"], sums["objects"]),
        **{f"attempts: {name}": (number, sums["attempts"]) for name, number in failed.items()},
    }


def cells(own: argparse.Namespace) -> list[Cell]:
    """All of a seed before another."""
    return [Fitted(spec, seed) for seed in range(own.seeds) for spec in own.specs]


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--specs", nargs="+", choices=list(SPECS), default=["bin_picking"])
    study.main("bin_picking", parser, DEFAULTS, cells)


if __name__ == "__main__":
    main()
