"""Bins in which a fitted policy acts, with what became of each trial."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from ddco_tasks.bin_picking.trials import Attempt, End, Trials

from ddco_pyro.fitting.fit import Fit
from ddco_pyro.simulation.episodes import Episode, run_episode
from ddco_pyro.simulation.task import Task


@dataclass(frozen=True)
class Trial:
    """A trial: its steps in the bin's episode, the objects that the jaws first lifted, and the whole attempt, None
    where the bin ended before the jaws opened.
    """

    steps: slice
    lifted: frozenset[int]
    attempt: Attempt | None


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

    def load(seed: int) -> Any:
        made.append(task.load(seed))
        return made[-1]

    watched = replace(task, load=load)
    episode = run_episode(watched, fit.controller(), seed, film=film, observed=fit.spec.observed)
    (environment,) = made
    return Bin(episode, environment.task.trials, _trials(environment.task, len(episode.choices)))


def _trials(task: Any, steps: int) -> list[Trial]:
    found, start = [], 0
    for attempt in task.trials.attempts:
        found.append(Trial(slice(start, start + attempt.steps), attempt.lifted, attempt))
        start += attempt.steps
    if start < steps:
        found.append(Trial(slice(start, steps), task.lifted or frozenset(), None))
    return found
