"""Bins in which a fitted policy acts, with what became of each trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from ddco_tasks.bin_picking.geometry import SHOWING
from ddco_tasks.bin_picking.trials import Attempt, End, Trials

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import Task

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


@dataclass(frozen=True)
class Bin:
    """A bin: its episode, how its trials ended, and the trials."""

    episode: Episode
    counted: Trials
    trials: list[Trial]

    def ending(self, trial: Trial) -> str:
        """How a trial of it ended: one of :data:`ENDINGS`, or how the bin did."""
        attempt, last = trial.attempt, trial is self.trials[-1]
        if attempt is None or (last and self.counted.end is End.LOST):
            assert self.counted.end is not None  # the episode is over
            return self.counted.end.value
        if not attempt.places:
            return "not let go"
        if len(attempt.carried) != 1 and not attempt.returned:
            return "none or several to a cup"
        if len(attempt.carried) < len(attempt.lifted):
            return "slipped"
        if len(attempt.carried) != 1:
            return "several taken" if attempt.carried else "nothing taken"
        if attempt.returned:
            return "one let go over the bin"
        own = attempt.places[0] == self.counted.own_cup(*attempt.carried)
        return "into its cup" if own else "into the wrong cup"


ENDINGS = (
    "into its cup",
    "nothing taken",
    "several taken",
    "slipped",
    "into the wrong cup",
    "one let go over the bin",
    "none or several to a cup",
    "not let go",
    "lost",
)
"""How a trial can end; with nothing or several taken, that they were let go over the bin again."""


def rolled(fit: Fit, task: Task, seed: int, film: bool = False) -> Bin:
    """The bin of a seed, in which the fitted policy acts."""
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
    episode = run_episode(watched, fit.controller(), seed, film=film, observed=fit.spec.observed)
    (environment,) = made
    return Bin(episode, environment.task.trials, trials(environment.task, loads))


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
