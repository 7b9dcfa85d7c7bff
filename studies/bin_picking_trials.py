"""Bins in which a fitted policy acts, with what became of each trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ddco_tasks.bin_picking.supervisor import SHOWN
from ddco_tasks.bin_picking.trials import Attempt, End, Trials

from ddco_pyro.fitting.fit import Fit
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import Task


@dataclass(frozen=True)
class Trial:
    """A trial: its steps in the bin's episode, the objects that the jaws first lifted, the whole attempt, None where
    the bin ended before the jaws opened, and what was held where a load is shown, None where it was over.
    """

    steps: slice
    lifted: frozenset[int]
    attempt: Attempt | None
    shown: frozenset[int] | None = None


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
    held: list[frozenset[int]] = []  # after each step

    def load(seed: int) -> Any:
        environment: Any = task.load(seed)
        made.append(environment)
        step = environment.step

        def stepped(control: np.ndarray) -> Any:
            told = step(control)
            held.append(environment.physics.held())
            return told

        environment.step = stepped
        return environment

    watched = replace(task, load=load)
    episode = run_episode(watched, fit.controller(), seed, film=film, observed=fit.spec.observed)
    (environment,) = made
    return Bin(episode, environment.task.trials, _trials(environment.task, held))


def _trials(task: Any, held: Sequence[frozenset[int]]) -> list[Trial]:
    found, start = [], 0
    for attempt in task.trials.attempts:
        found.append(_trial(slice(start, start + attempt.steps), attempt.lifted, attempt, held))
        start += attempt.steps
    if start < len(held):
        found.append(_trial(slice(start, len(held)), task.lifted or frozenset(), None, held))
    return found


def _trial(steps: slice, lifted: frozenset[int], attempt: Attempt | None, held: Sequence[frozenset[int]]) -> Trial:
    own = held[steps]
    return Trial(steps, lifted, attempt, own[SHOWN - 1] if len(own) >= SHOWN else None)
