"""Policies in a task: episodes, what came of them, and how sure one can be of that."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from scipy import stats

from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.simulation.task import Policy, Task, find_task

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Episode:
    """One episode: the ``record`` of observations and (intended) controls, the task's ``outcome``, the ``choices``
    of each level at each step [T, D] where a controller acted, and ``frames`` uint8 [T + 1, H, W, 3] where filmed.
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
    """Run one episode from the initial state that ``seed`` draws, with a policy or the task's scripted one so named.

    :param observed: what the policy or the record needs; of the task's cameras those named here are drawn.
    :param keep: the observations to record; all of them if None.
    """
    environment = task.watched(seed, observed)
    try:
        actor = task.policies[policy](environment) if isinstance(policy, str) else policy
        actor.reset(seed)
        step = environment.reset()
        seen: list[Mapping[str, np.ndarray]] = []
        controls, choices, labels, frames = [], [], [], []
        while not step.last():
            frames += [task.frame(environment)] if film else []
            kept = step.observation.keys() if keep is None else step.observation.keys() & set(keep)
            seen.append({key: np.array(step.observation[key]) for key in kept})
            control = np.array(actor.act(step.observation), dtype=np.float64)
            controls.append(np.array(getattr(actor, "intended", control), dtype=np.float64))
            choices.append(getattr(actor, "choices", ()))
            labels.append(dict(getattr(actor, "annotations", {})))
            step = environment.step(control)
        frames += [task.frame(environment)] if film else []
        outcome = task.measured(environment)
    finally:
        environment.close()
    record = Demonstration(
        name=f"demo_{seed}",
        observations={key: np.stack([observation[key] for observation in seen]) for key in seen[0]},
        actions=np.stack(controls),
        labels={key: np.array([annotation[key] for annotation in labels]) for key in labels[0]},
        attributes={"seed": seed, **outcome},
    )
    return Episode(seed, record, outcome, np.array(choices, dtype=int).reshape(len(controls), -1), frames)


def run_episodes(
    task: str,
    policy: Policy | str,
    seeds: Sequence[int],
    film: int = 0,
    jobs: int = -1,
    observed: Collection[str] = (),
    keep: Collection[str] | None = None,
) -> Iterable[Episode]:
    """Episodes from each seed in turn, in parallel processes; the first ``film`` of them with frames.

    :param task: the task's name, as :func:`ddco_pyro.simulation.task.find_task` takes it.
    :param observed: as ``keep``, those of :func:`run_episode`.
    """
    calls = (
        delayed(_run_named)(task, policy, seed, number < film, observed, keep) for number, seed in enumerate(seeds)
    )
    episodes: Iterable[Episode] = Parallel(n_jobs=jobs, return_as="generator")(calls)
    return episodes


def _run_named(task: str, *how: Any) -> Episode:
    return run_episode(find_task(task), *how)


def summarize(task: Task, outcomes: Sequence[Mapping[str, float]]) -> dict[str, dict[str, Any]]:
    """Each measure over episodes: a rate with its Wilson 95 % interval, or a mean with Student's, as the task declares.

    NaN (does not apply to this episode) is left out of ``trials``.
    """
    summary = {}
    for name in dict.fromkeys(name for outcome in outcomes for name in outcome):
        values = np.array([outcome.get(name, np.nan) for outcome in outcomes])
        values = values[~np.isnan(values)]
        summary[name] = rate(int(values.sum()), len(values)) if task.kind(name) == "rate" else mean(values)
    return summary


def mean(values: np.ndarray) -> dict[str, Any]:
    """A mean with its standard deviation and Student's 95 % interval, both of which take two values at least."""
    trials = len(values)
    centre = float(values.mean()) if trials else None
    if centre is None or trials < 2:
        return {"mean": centre, "std": None, "trials": trials, "interval": None}
    spread = float(values.std(ddof=1))
    half = float(spread / np.sqrt(trials) * stats.t.ppf((1 + CONFIDENCE) / 2, trials - 1))
    return {"mean": centre, "std": spread, "trials": trials, "interval": [centre - half, centre + half]}


def rate(successes: int, trials: int) -> dict[str, Any]:
    """A success rate and its Wilson 95 % interval."""
    if trials == 0:
        return {"successes": 0, "trials": 0, "rate": None, "interval": None}
    interval = stats.binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return {
        "successes": successes,
        "trials": trials,
        "rate": successes / trials,
        "interval": [float(interval.low), float(interval.high)],
    }


def paired_difference(ours: Sequence[float], theirs: Sequence[float]) -> dict[str, Any]:
    """Successes on the same initial states: how often only one of the two succeeded, and McNemar's exact p-value."""
    only_ours = int(sum(a > b for a, b in zip(ours, theirs, strict=True)))
    only_theirs = int(sum(a < b for a, b in zip(ours, theirs, strict=True)))
    discordant = only_ours + only_theirs
    p_value = float(stats.binomtest(only_ours, discordant).pvalue) if discordant else 1.0
    return {"only_ours": only_ours, "only_theirs": only_theirs, "trials": len(ours), "p_value": p_value}
