"""What policies do with what they hold where a load is shown, which is when it is decided where to go.

    python studies/bin_picking_recovery.py RUN... [--bins 20] [--jobs 1]

RUN is the folder of a fit of ``specs/bin_picking.yaml``, such as ``studies/bin_picking.py`` makes; it and its baselines
clear the bins of its training seed. The paper's criteria count what is held when the jaws open, and so what slipped on
the way to a cup, which the demonstrator, who does not look again, does not take back either. Here nothing and several
are what is held when it is shown. Writes ``docs/results/bin_picking/recovery.json`` and ``recovery.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rates
import torch
from bin_picking import OURS, STARTS, clustered
from bin_picking_trials import Trial, rolled
from cells import printed
from ddco_tasks.bin_picking import task
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fitted import Fit, load

OUT = Path("docs/results/bin_picking")
NUMBERS = ("nothing", "one", "several")
"""Of what is held where it is shown."""
CRITERIA = {
    "nothing or several, taken back": ("back", "due back"),
    "nothing, taken back": ("nothing back", "nothing"),
    "nothing, and nothing falls through the picture, taken back": ("unseen back", "unseen"),
    "several, taken back": ("several back", "several"),
    "exactly one, let go over the bin": ("one back", "one"),
    "exactly one, lost on the way to a cup": ("one lost", "one"),
}
"""By name: what is counted of a bin, and among what."""


def counted(trials: Sequence[Trial]) -> dict[str, int]:
    """How many trials of a bin showed nothing, one and several objects before the jaws opened; how many of these went
    back over the bin; the same of nothing where the picture had nothing either; and how many, with one object, had lost
    it when the jaws opened elsewhere.
    """
    found = {f"{name}{back}": 0 for name in (*NUMBERS, "unseen") for back in ("", " back")} | {"one lost": 0}
    for trial in trials:
        if trial.load is None or trial.attempt is None or not trial.attempt.places:
            continue
        name = NUMBERS[min(len(trial.load.held), 2)]
        for one in [name] if trial.load.seen or trial.load.held else [name, "unseen"]:
            found[one] += 1
            found[f"{one} back"] += trial.attempt.returned
        if name == "one" and not trial.attempt.returned and not trial.attempt.carried:
            found["one lost"] += 1
    due = {"due back": found["nothing"] + found["several"], "back": found["nothing back"] + found["several back"]}
    return found | due


def played(run: Path, name: str, number: int) -> dict[str, int]:
    """What a method of a run does in a bin of the run's training seed."""
    torch.set_num_threads(1)
    fit = methods(load(run))[name]
    return counted(rolled(fit, task, STARTS + 1000 * fit.spec.seed + number).trials)


def methods(fit: Fit) -> dict[str, Fit]:
    """A fit and its baselines, by the names that the study has for them."""
    return {**fit.baselines, OURS: fit}


def page(results: Mapping[str, Mapping[str, Any]], made_by: str) -> str:
    """The results as Markdown."""
    lines = [made_by, "", f"| held where it is shown | {' | '.join(results)} |", "|---" * (len(results) + 1) + "|"]
    for name in CRITERIA:
        lines.append(f"| {name} | {' | '.join(rates.shown(one[name]) for one in results.values())} |")
    lines += ["", "Wilson 95 % intervals, for as many independent trials as the variance between bins gives."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--bins", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=1)
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Play, and write what came of it; the page."""
    command = f"python studies/bin_picking_recovery.py {' '.join(map(str, own.runs))} --bins {own.bins}"
    made_by = record(command)
    names = list(methods(load(own.runs[0])))
    cases = [(name, run, number) for name in names for run in own.runs for number in range(own.bins)]
    found = Parallel(n_jobs=own.jobs)(delayed(played)(run, name, number) for name, run, number in cases)
    bins = {name: [one for (of, *_), one in zip(cases, found, strict=True) if of == name] for name in names}
    results = {name: {key: clustered(one, *pair) for key, pair in CRITERIA.items()} for name, one in bins.items()}
    shown = page(results, sentence(command, [made_by]))
    write_text(OUT / "recovery.json", text(results, [made_by]))
    write_text(OUT / "recovery.md", shown)
    return shown


if __name__ == "__main__":
    main()
