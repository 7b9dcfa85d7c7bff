"""Grasps of objects that no demonstration has shown: thread, diode, nail and screw (SM 1.4).

    python studies/bin_picking_unseen.py RUN... [--grasps 20] [--kinds thread diode nail screw pin needle wire]
        [--jobs 1]

RUN is the folder of a fit of ``specs/bin_picking.yaml``, such as ``studies/bin_picking.py`` makes. One object lies
alone in the bin, dropped there anew for each grasp; what becomes of the first attempt is counted, for the objects of
the demonstrations too. Writes ``docs/results/bin_picking/unseen.json`` and ``unseen.md``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rates
import torch
from bin_picking_trials import Trial, rolled
from cells import printed
from ddco_tasks.bin_picking import alone
from ddco_tasks.bin_picking.objects import KINDS, UNSEEN
from joblib import Parallel, delayed
from provenance import record, sentence, text

from ddco_pyro.data.files import write_text
from ddco_pyro.fitting.fitted import load
from ddco_pyro.simulation.episodes import rate

OUT = Path("docs/results/bin_picking")
STARTS = 970_000
"""Seed of the first run's first drop of the first kind; drops are others for each kind and each run."""
PLACES = ("accept", "reject", "bin", "lost", "not let go")
SURE = 3
"""So many of these are the policy's choice, and have an interval on the page."""
PAPER = {"thread": (10, 0, 9, 1), "diode": (10, 10, 0, 0), "nail": (8, 0, 0, 8), "screw": (4, 0, 4, 0)}
"""Of ten grasps: that took the object, and dropped it in the accept cup, in the reject cup, and back."""


def grasped(run: Path, kind: str, seed: int) -> str:
    """What became of the first grasp of an object: one of :data:`PLACES`, or ``nothing`` where it took nothing."""
    torch.set_num_threads(1)
    return place(rolled(load(run), alone[kind], seed).trials[0])


def place(trial: Trial) -> str:
    """Where what a trial lifted was dropped; ``lost`` is on the way, or outside of bin and cups."""
    if not trial.lifted:
        return "nothing"
    if trial.attempt is None or (trial.attempt.places and not trial.attempt.carried):
        return "lost"
    if not trial.attempt.places:
        return "not let go"
    return "lost" if trial.attempt.places[0] == "outside" else trial.attempt.places[0]


def counted(places: Sequence[str]) -> dict[str, Any]:
    """Of all grasps those that took the object, and of these where it was dropped, with Wilson intervals."""
    taken = [one for one in places if one != "nothing"]
    dropped = {name: rate(taken.count(name), len(taken)) for name in PLACES}
    return {"taken": rate(len(taken), len(places)), "dropped": dropped}


def page(results: Mapping[str, Any], runs: int, made_by: str) -> str:
    """The results as Markdown."""
    called = ("accept cup", "reject cup", "back over the bin", "lost on the way", "not let go")
    lines = [made_by, "", f"| object, alone in the bin | taken | {' | '.join(called)} |", "|---" * 7 + "|"]
    for kind, one in results.items():
        pooled, dropped = one["pooled"], list(one["pooled"]["dropped"].values())
        cells = [rates.shown(pooled["taken"]), *map(rates.shown, dropped[:SURE])]
        cells += [str(each["successes"]) for each in dropped[SURE:]]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
        if kind in PAPER:
            taken, *places = PAPER[kind]
            cells = [f"{taken} of 10", *(f"{number} of {taken}" for number in places), "-", "-"]
            lines.append(f"| *paper: {kind}* | {' | '.join(cells)} |")
    lines += ["", f"| object, by fit | {' | '.join(map(str, range(runs)))} |", "|---" * (runs + 1) + "|"]
    for kind, one in results.items():
        cells = [f"{each['taken']['successes']} taken, {_mostly(each['dropped'])}" for each in one["by run"]]
        lines.append(f"| {kind} | {' | '.join(cells)} |")
    lines += [
        "",
        "Where it was dropped is counted among the grasps that took it. Each fit had drops of its own; below, where it "
        "dropped most. Wilson 95 % intervals over the grasps of all fits, which do not say how much fits differ.",
    ]
    return "\n".join(lines) + "\n"


def _mostly(dropped: Mapping[str, Any]) -> str:
    name = max(dropped, key=lambda place: dropped[place]["successes"] or 0)
    return f"{dropped[name]['successes']} of them {name}"


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--grasps", type=int, default=20)
    parser.add_argument("--kinds", nargs="+", choices=[*UNSEEN, *KINDS], default=[*UNSEEN, *KINDS])
    parser.add_argument("--jobs", type=int, default=1)
    own = parser.parse_args()
    printed(lambda: run(own))


def run(own: argparse.Namespace) -> str:
    """Play, and write what came of it; the page."""
    runs, kinds = " ".join(map(str, own.runs)), " ".join(own.kinds)
    command = f"python studies/bin_picking_unseen.py {runs} --grasps {own.grasps} --kinds {kinds}"
    made_by = record(command)
    cases = [(run, kind) for run in range(len(own.runs)) for kind in own.kinds]
    calls = (
        delayed(grasped)(own.runs[run], kind, STARTS + 10_000 * run + 1000 * [*UNSEEN, *KINDS].index(kind) + number)
        for run, kind in cases
        for number in range(own.grasps)
    )
    found = iter(Parallel(n_jobs=own.jobs)(calls))
    places = {case: [next(found) for _ in range(own.grasps)] for case in cases}
    results = {kind: _of(kind, places, len(own.runs)) for kind in own.kinds}
    shown = page(results, len(own.runs), sentence(command, [made_by]))
    write_text(OUT / "unseen.json", text(results, [made_by]))
    write_text(OUT / "unseen.md", shown)
    return shown


def _of(kind: str, places: Mapping[tuple[int, str], list[str]], runs: int) -> dict[str, Any]:
    each = [places[run, kind] for run in range(runs)]
    return {"pooled": counted([place for one in each for place in one]), "by run": [counted(one) for one in each]}


if __name__ == "__main__":
    main()
