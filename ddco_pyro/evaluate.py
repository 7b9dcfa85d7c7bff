"""Rollouts of a run: its model, its baselines and the task's scripted policies on the same initial states."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from typing import Any

from ddco_pyro.files import write_text
from ddco_pyro.rollout import Episode, paired_difference, run_episodes, summarize
from ddco_pyro.run import Fit, RunError, write_metrics
from ddco_pyro.task import SUCCESS, Policy, Task, find_task
from ddco_pyro.video import write_film

OnEpisode = Callable[[str], None]


def policies(fit: Fit) -> dict[str, Policy | str]:
    """Every method to roll out, by name: scripted policies, baselines, and the model itself last.

    :raises RunError: the spec has no task, or names a scripted policy that the task lacks.
    """
    if fit.spec.task is None:
        raise RunError(f"{fit.folder}: its spec has no task, so there is nothing to roll out in")
    known = find_task(fit.spec.task).policies
    unknown = [name for name in fit.spec.rollout.policies if name not in known]
    if unknown:
        raise RunError(
            f"rollout.policies: task {fit.spec.task!r} has no {', '.join(unknown)} (it has: {', '.join(known)})"
        )
    scripted: dict[str, Policy | str] = {name: name for name in fit.spec.rollout.policies}
    return scripted | {name: one.controller() for name, one in fit.baselines.items()} | {fit.name: fit.controller()}


def roll_out(fit: Fit, episodes: int, film: int, on_episode: OnEpisode, jobs: int = -1) -> dict[str, Any]:
    """Roll every method out from the same ``episodes`` initial states; fills ``rollouts.csv``, ``videos/`` and
    ``metrics.json``.

    :param film: how many episodes of each method to film.
    :returns: what ``metrics.json`` now has under ``rollouts``.
    """
    seeds = range(fit.spec.rollout.seed, fit.spec.rollout.seed + episodes)
    found: dict[str, list[Episode]] = {}
    for name, policy in policies(fit).items():
        found[name] = []
        for episode in run_episodes(str(fit.spec.task), policy, seeds, film, jobs):
            found[name].append(episode)
            if episode.frames:
                write_film(fit.folder / "videos" / f"{name}-{episode.seed}.mp4", episode)
            on_episode(name)
    write_text(fit.folder / "rollouts.csv", _table(found))
    methods = _methods(find_task(str(fit.spec.task)), found, fit.name)
    results = {"seed": seeds.start, "episodes": episodes, "methods": methods}
    write_metrics(fit.folder, fit.metrics | {"rollouts": results})
    return results


def _methods(task: Task, found: dict[str, list[Episode]], ours: str) -> dict[str, Any]:
    def successes(name: str) -> list[float]:
        return [episode.outcome[SUCCESS] for episode in found[name]]

    methods: dict[str, Any] = {}
    for name, episodes in found.items():
        methods[name] = {"measures": summarize(task, [episode.outcome for episode in episodes])}
        if name != ours and all(SUCCESS in episode.outcome for episode in episodes):
            methods[name]["against"] = paired_difference(successes(ours), successes(name))
    return methods


def _table(found: dict[str, list[Episode]]) -> str:
    text = io.StringIO()
    measures = list(dict.fromkeys(key for episodes in found.values() for one in episodes for key in one.outcome))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "seed", *measures])
    writer.writerows(_rows(found, measures))
    return text.getvalue()


def _rows(found: dict[str, list[Episode]], measures: list[str]) -> Iterator[list[Any]]:
    for name, episodes in found.items():
        for one in episodes:
            yield [name, one.seed, *(one.outcome.get(measure) for measure in measures)]
