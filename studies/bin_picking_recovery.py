"""What policies do with what they hold where a load is shown, which is when it is decided where to go.

    python studies/bin_picking_recovery.py RUN... [--bins 20] [--jobs 1]

RUN is the folder of a fit of ``specs/bin_picking.yaml``, such as ``studies/bin_picking.py`` makes; it and its baselines
clear the bins of its training seed. The paper's criteria count what is held when the jaws open, and so what slipped on
the way to a cup, which the demonstrator does not take back either. Here nothing and several are what is held when it is
shown. Adds its numbers to ``docs/results/bin_picking.csv``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from bin_picking import DEMONSTRATIONS, OURS, STARTS
from ddco_tasks.bin_picking import task
from ddco_tasks.bin_picking.geometry import SHOWING
from ddco_tasks.bin_picking.trials import Attempt
from joblib import Parallel, delayed
from study import RESULTS, Row, add, described, printed, shown

from ddco_pyro.fitting.fitted import Fit, load
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import Task

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


NEAR = 0.010  # m: a gripper so near to where loads are shown shows what it holds; demonstrated ones are within 8 mm


class Load(NamedTuple):
    """What a step ended with: the objects that were held, whether the gripper was where loads are shown, and whether
    the picture had anything there.
    """

    held: frozenset[int]
    shown: bool
    seen: bool


@dataclass(frozen=True)
class Trial:
    """A trial: its steps in the bin's episode, the objects that the jaws first lifted, the whole attempt, None where
    the bin ended before the jaws opened, and the load when it was first shown, None where it never was.
    """

    steps: slice
    lifted: frozenset[int]
    attempt: Attempt | None
    load: Load | None = None


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


def rolled(fit: Fit, task: Task, seed: int) -> list[Trial]:
    """The trials of a seed's bin, in which the fitted policy acts."""
    made: list[Any] = []
    loads: list[Load] = []  # after each step

    def load(seed: int) -> Any:
        environment: Any = task.load(seed)
        made.append(environment)
        step = environment.step

        def stepped(control: np.ndarray) -> Any:
            told = step(control)
            physics = environment.physics
            shown = np.linalg.norm(physics.gripper().position - SHOWING) < NEAR
            loads.append(Load(physics.held(), bool(shown), bool(np.any(told.observation["load"]))))
            return told

        environment.step = stepped
        return environment

    watched = replace(task, load=load)
    run_episode(watched, fit.controller(), seed, observed=fit.spec.observed)
    (environment,) = made
    return trials(environment.task, loads)


def trials(task: Any, loads: Sequence[Load]) -> list[Trial]:
    """The trials of a bin whose steps ended with these loads."""
    found, start = [], 0
    for attempt in task.trials.attempts:
        found.append(_trial(slice(start, start + attempt.steps), attempt.lifted, attempt, loads))
        start += attempt.steps
    if start < len(loads):
        found.append(_trial(slice(start, len(loads)), task.lifted or frozenset(), None, loads))
    return found


def _trial(steps: slice, lifted: frozenset[int], attempt: Attempt | None, loads: Sequence[Load]) -> Trial:
    return Trial(steps, lifted, attempt, next((load for load in loads[steps] if load.shown), None))


def played(run: Path, name: str, number: int) -> dict[str, int]:
    """What a method of a run does in a bin of the run's training seed."""
    torch.set_num_threads(1)
    fit = methods(load(run))[name]
    return counted(rolled(fit, task, STARTS + 1000 * fit.spec.seed + number))


def methods(fit: Fit) -> dict[str, Fit]:
    """A fit and its baselines, by the names that the study has for them."""
    return {**fit.baselines, OURS: fit}


def rows(runs: Sequence[Path], bins: int, jobs: int) -> Iterator[Row]:
    """Of each method and run the share of each criterion, and its trials."""
    for run in runs:
        seed = load(run).spec.seed
        for name in methods(load(run)):
            found = Parallel(n_jobs=jobs)(delayed(played)(run, name, number) for number in range(bins))
            for measure, (of, among) in CRITERIA.items():
                count, trials = (sum(one[key] for one in found) for key in (of, among))
                named = "recovery", "bins", name, DEMONSTRATIONS, seed
                if trials:
                    yield Row(*named, measure, count / trials)
                    yield Row(*named, f"{measure}, trials", trials)


def main() -> None:
    """Play, and write what came of it."""
    parser = described(__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--bins", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=1)
    own = parser.parse_args()

    def work() -> str:
        found = list(rows(own.runs, own.bins, own.jobs))
        add(RESULTS / "bin_picking.csv", found)
        return shown(found)

    printed(work)


if __name__ == "__main__":
    main()
