"""Episodes of policies in a task, and summaries of their outcomes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.simulation.task import Observation, Policy, Task, find_task
from ddco_pyro.statistics import mean, rate

if TYPE_CHECKING:
    import dm_env


@dataclass(frozen=True)
class Episode:
    """One episode of T steps.

    :param record: observations, intended controls and labels.
    :param outcome: the task's measures.
    :param choices: the active option of each level, lowest first, [T, D]; D is 0 for other policies than controllers.
    :param frames: pictures of the scene, uint8 [H, W, 3]: T + 1 where the episode was filmed, otherwise none.
    """

    seed: int
    record: Demonstration
    outcome: dict[str, float]
    choices: np.ndarray
    frames: list[np.ndarray] = field(default_factory=list)


class Policies(Protocol):
    """A policy of N episodes at once, such as :class:`ddco_pyro.acting.controller.Controller`.

    ``all_choices`` [N, D] are the active options after :meth:`act_all`.
    """

    all_choices: Any

    def reset_all(self, seeds: Sequence[int]) -> None:
        """Begin N episodes. Equal seeds give equal episodes."""

    def act_all(self, observations: Sequence[Observation]) -> Sequence[np.ndarray] | np.ndarray:
        """The control of each episode, in the task's own units."""


class _One:
    """A policy of one episode as :class:`Policies`."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def reset_all(self, seeds: Sequence[int]) -> None:
        self.policy.reset(*seeds)

    def act_all(self, observations: Sequence[Observation]) -> list[np.ndarray]:
        control = np.array(self.policy.act(observations[0]), dtype=np.float64)
        self.all_choices = [getattr(self.policy, "choices", ())]
        self.all_intended = [getattr(self.policy, "intended", control)]
        self.all_annotations = [getattr(self.policy, "annotations", {})]
        return [control]


def run_episode(
    task: Task,
    policy: Policy | str,
    seed: int,
    film: bool = False,
    observed: Collection[str] = (),
    keep: Collection[str] | None = None,
) -> Episode:
    """Run one episode from the initial state of a seed.

    :param policy: a policy, or the name of one of the task's scripted policies.
    :param film: keep a frame of every step.
    :param observed: observations that the policy or the record needs; cameras among them are drawn.
    :param keep: the observations to record; all of them if None.
    """
    (episode,) = _run(
        task,
        lambda environments: _One(task.policies[policy](environments[0]) if isinstance(policy, str) else policy),
        [seed],
        film,
        observed,
        keep,
    )
    return episode


def play(
    task: Task,
    policies: Policies,
    seeds: Sequence[int],
    observed: Collection[str] = (),
    keep: Collection[str] | None = (),
) -> list[Episode]:
    """Run one episode for each seed in lockstep: networks see all episodes in one pass for each step.

    Each episode is the one that :func:`run_episode` gives for its seed.

    :param observed: observations that the policies need; cameras among them are drawn.
    :param keep: the observations to record; all of them if None.
    """
    return _run(task, lambda _: policies, seeds, False, observed, keep)


def _run(
    task: Task,
    make: Callable[[list[dm_env.Environment]], Policies],
    seeds: Sequence[int],
    film: bool,
    observed: Collection[str],
    keep: Collection[str] | None,
) -> list[Episode]:
    environments = [task.watched(seed, observed) for seed in seeds]
    try:
        policies = make(environments)
        policies.reset_all(seeds)
        steps = [environment.reset() for environment in environments]
        logs = [_Log() for _ in seeds]
        while True:
            if film:
                for log, environment in zip(logs, environments, strict=True):
                    log.frames.append(task.frame(environment))
            if all(step.last() for step in steps):
                break
            controls = policies.act_all([step.observation for step in steps])
            intended = getattr(policies, "all_intended", controls)
            annotations = getattr(policies, "all_annotations", [{}] * len(seeds))
            for n, step in enumerate(steps):
                if not step.last():
                    logs[n].add(step.observation, keep, intended[n], policies.all_choices[n], annotations[n])
                    steps[n] = environments[n].step(controls[n])
        outcomes = [task.measured(environment) for environment in environments]
    finally:
        for environment in environments:
            environment.close()
    return [log.episode(seed, outcome) for log, seed, outcome in zip(logs, seeds, outcomes, strict=True)]


class _Log:
    """The steps of one episode."""

    def __init__(self) -> None:
        self.observations: list[dict[str, np.ndarray]] = []
        self.controls: list[np.ndarray] = []
        self.choices: list[np.ndarray] = []
        self.labels: list[dict[str, int]] = []
        self.frames: list[np.ndarray] = []

    def add(
        self,
        observation: Observation,
        keep: Collection[str] | None,
        control: np.ndarray,
        choices: Sequence[int],
        labels: Mapping[str, int],
    ) -> None:
        keys = observation.keys() if keep is None else observation.keys() & set(keep)
        self.observations.append({key: np.array(observation[key]) for key in keys})
        self.controls.append(np.array(control, dtype=np.float64))
        self.choices.append(np.array(choices, dtype=int))
        self.labels.append(dict(labels))

    def episode(self, seed: int, outcome: dict[str, float]) -> Episode:
        record = Demonstration(
            name=f"demo_{seed}",
            observations={key: np.stack([step[key] for step in self.observations]) for key in self.observations[0]},
            actions=np.stack(self.controls),
            labels={key: np.array([step[key] for step in self.labels]) for key in self.labels[0]},
            attributes={"seed": seed, **outcome},
        )
        return Episode(seed, record, outcome, np.stack(self.choices), self.frames)


def run_episodes(
    task: str,
    policy: Policy | str,
    seeds: Sequence[int],
    film: int = 0,
    jobs: int = -1,
    observed: Collection[str] = (),
    keep: Collection[str] | None = None,
) -> Iterator[Episode]:
    """Episodes of each seed in turn, from parallel processes; the first ``film`` of them have frames.

    :param task: the task's name for :func:`ddco_pyro.simulation.task.find_task`.
    :param observed: see :func:`run_episode`, also for ``keep``.
    :raises Failed: a process died.
    """
    calls = {seed: partial(_run_named, task, policy, seed, seed in seeds[:film], observed, keep) for seed in seeds}
    with run_all(calls, Workers(jobs), "ran episodes", ordered=True) as episodes:
        yield from (episode for _, episode in episodes)


def _run_named(task: str, *how: Any) -> Episode:
    return run_episode(find_task(task), *how)


def summarize(task: Task, outcomes: Sequence[Mapping[str, float]]) -> dict[str, dict[str, Any]]:
    """Each measure over episodes: a rate with its Wilson 95 % interval, or a mean with Student's 95 % interval.

    Episodes to which a measure does not apply (NaN) are not among its ``trials``.
    """
    summary = {}
    for name in dict.fromkeys(name for outcome in outcomes for name in outcome):
        values = np.array([outcome.get(name, np.nan) for outcome in outcomes])
        values = values[~np.isnan(values)]
        summary[name] = rate(int(values.sum()), len(values)) if task.kind(name) == "rate" else mean(values)
    return summary
