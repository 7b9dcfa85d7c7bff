"""How long does a selection over k = 1 to 8 on the needle data take, and how much faster is it on two cores?

    python benchmarks/selection_time.py folds        # one fold of each candidate, in seconds of CPU python
    benchmarks/selection_time.py speed-up     # a short selection with one process and with two, in seconds

``folds`` counts the time of the CPU, so it can be measured beside other work; ten folds on two idle cores
take at least five times the sum. ``speed-up`` compares clocks, and says how busy the machine was: on a busy
one it means little. Writes ``benchmarks/results/selection_time_folds.json`` and
``selection_time_speed_up.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

from ddco_pyro.data.files import write_text
from ddco_pyro.events import CellDone, Event
from ddco_pyro.fitting.fit import fit
from ddco_pyro.selection import Workers, grid, select
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import demonstrations
from ddco_pyro.training.networks import Dimensions

OUT = Path("benchmarks/results")
GRID = "selection.grid.hierarchy.levels.0.count=[1, 2, 3, 4, 5, 6, 7, 8]"
SHORT = ("selection.grid.hierarchy.levels.0.count=[2, 3, 4, 5]", "selection.folds=4", "training.epochs=100")


def one_fold() -> dict[str, Any]:
    """Seconds of CPU that the first of ten folds takes for each candidate of the needle spec."""
    spec = load_spec("specs/needle.yaml", [GRID])
    fold, *_ = grid.divide(demonstrations(spec), spec.selection.folds, spec.seed)
    seconds = {}
    for candidate in grid.candidates(spec, Dimensions.of(fold)):
        start = time.process_time()
        fit(candidate.spec, fold)
        seconds[candidate.name] = time.process_time() - start
        print(candidate.name, seconds[candidate.name], flush=True)
    return {"cpu_seconds": seconds, "sum": sum(seconds.values()), "folds": spec.selection.folds}


def speed_up() -> dict[str, Any]:
    """Seconds of the clock of a short selection with one process and with two, starting them left out."""
    spec = load_spec("specs/needle.yaml", [*SHORT, "training.patience=null"])
    demonstrations(spec)  # collected before the clock starts
    found: dict[str, Any] = {"load_before": os.getloadavg()[0]}
    for jobs in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            clock = Clock()
            select(spec, Path(folder) / "run", clock, Workers(jobs))
        found[f"seconds_{jobs}"] = clock.ends[-1] - clock.ends[jobs - 1]
        found[f"folds_{jobs}"] = len(clock.ends) - jobs
    per_fold = {jobs: found[f"seconds_{jobs}"] / found[f"folds_{jobs}"] for jobs in (1, 2)}
    return found | {"speed_up": per_fold[1] / per_fold[2], "load_after": os.getloadavg()[0]}


class Clock:
    """When each fold was done."""

    def __init__(self) -> None:
        self.ends: list[float] = []

    def __call__(self, event: Event) -> None:
        """A fold is done, or something else has happened."""
        if isinstance(event, CellDone):
            self.ends.append(time.monotonic())


def main() -> None:
    """Measure."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("what", choices=["folds", "speed-up"])
    what = parser.parse_args().what
    found = one_fold() if what == "folds" else speed_up()
    print(json.dumps(found, indent=1))
    write_text(OUT / f"selection_time_{what.replace('-', '_')}.json", json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
