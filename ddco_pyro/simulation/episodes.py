"""Episodes of policies in a task, and summaries of their outcomes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Measure
from ddco_pyro.simulation.task import Policy, Task, find_task
from ddco_pyro.spec import TASK
from ddco_pyro.statistics import mean, rate


@dataclass(frozen=True)
class Episode:
    """One episode of T steps.

    :param record: observations, intended controls and labels.
    :param outcome: the task's measures.
    :param choices: the active option of each level, lowest first, [T, D]; D is 0 for all but controllers.
    :param frames: pictures of the scene, uint8 [H, W, 3]: T + 1 where the episode was filmed, otherwise none.
    """

    seed: int
    record: Demonstration
    outcome: dict[str, float]
    choices: np.ndarray
    frames: list[np.ndarray] = field(default_factory=list)


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
    environment = task.watched(seed, observed)
    frames: list[np.ndarray] = []
    observations: list[dict[str, np.ndarray]] = []
    controls: list[np.ndarray] = []
    choices: list[np.ndarray] = []
    labels: list[dict[str, int]] = []
    try:
        actor = task.policies[policy](environment) if isinstance(policy, str) else policy
        actor.reset(seed)
        step = environment.reset()
        while True:
            if film:
                frames.append(task.frame(environment))
            if step.last():
                break
            seen: dict[str, Any] = {TASK: task.name, **step.observation}
            control = np.array(actor.act(seen), dtype=np.float64)
            keys = step.observation.keys() if keep is None else step.observation.keys() & set(keep)
            observations.append({key: np.array(step.observation[key]) for key in keys})
            controls.append(np.array(getattr(actor, "intended", control), dtype=np.float64))
            choices.append(np.array(getattr(actor, "choices", ()), dtype=int))
            labels.append(dict(getattr(actor, "annotations", {})))
            step = environment.step(control)
        outcome = task.measured(environment)
    finally:
        environment.close()
    record = Demonstration(
        name=f"demo_{seed}",
        observations={key: np.stack([seen[key] for seen in observations]) for key in observations[0]},
        actions=np.stack(controls),
        labels={key: np.array([said[key] for said in labels]) for key in labels[0]},
        attributes={"seed": seed, **outcome},
    )
    return Episode(seed, record, outcome, np.stack(choices), frames)


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
    run = partial(_run_named, task, policy)
    calls = {seed: partial(run, seed, seed in seeds[:film], observed, keep) for seed in seeds}
    with run_all(calls, Workers(jobs), "ran episodes", ordered=True) as episodes:
        yield from (episode for _, episode in episodes)


def _run_named(task: str, *how: Any) -> Episode:
    return run_episode(find_task(task), *how)


def summarize(task: Task, outcomes: Sequence[Mapping[str, float]]) -> dict[str, Measure]:
    """Each measure over episodes: a rate with Wilson's 95 % interval, a mean with Student's 95 % interval.

    Episodes to which a measure does not apply (NaN) are not among its ``trials``.
    """
    summary: dict[str, Measure] = {}
    for name in dict.fromkeys(name for outcome in outcomes for name in outcome):
        values = np.array([outcome.get(name, np.nan) for outcome in outcomes])
        values = values[~np.isnan(values)]
        summary[name] = rate(int(values.sum()), len(values)) if task.kind(name) == "rate" else mean(values)
    return summary
