"""Rollouts of a run: its model, its baselines and the task's scripted policies on the same initial states."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, model_validator

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.files import json_text, write_text
from ddco_pyro.errors import command
from ddco_pyro.evaluation.worth import success_worth
from ddco_pyro.events import EpisodeEnded, OnEvent, ignore
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.run import RunError
from ddco_pyro.metrics import Method, Record, Rollouts, read_record, write_table
from ddco_pyro.simulation.episodes import run_episodes, summarize
from ddco_pyro.simulation.film import write_film
from ddco_pyro.simulation.task import SUCCESS, Policy, Task, find_task
from ddco_pyro.spec.base import invalid
from ddco_pyro.statistics import paired_difference

OrNaN = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number; NaN, null in the file, for a measure that does not apply."""

FIRST_SEED = 1000
"""Seed of the first episode; each following episode adds 1."""


def policies(fit: Fit, best: bool = False) -> dict[str, Policy | str]:
    """The policies to roll out, by name: scripted ones, baselines, and the model itself last.

    :param best: of the fitted ones, :attr:`Fit.best` alone.
    :raises RunError: the spec has no task, or names a scripted policy that the task lacks.
    """
    if fit.spec.task is None:
        raise RunError(f"{fit.place}: its spec has no task, so there is nothing to roll out in")
    known = find_task(fit.spec.task).policies
    unknown = [name for name in fit.spec.rollout.policies if name not in known]
    if unknown:
        raise RunError(
            f"rollout.policies: task {fit.spec.task!r} has no {', '.join(unknown)} (it has: {', '.join(known)})"
        )
    scripted: dict[str, Policy | str] = {name: name for name in fit.spec.rollout.policies}
    if best:
        return scripted | {fit.best.name: fit.best.controller()}
    return scripted | {name: other.controller() for name, other in fit.baselines.items()} | {fit.name: fit.controller()}


def roll_out(
    fit: Fit,
    episodes: int,
    film: int = 0,
    on_event: OnEvent = ignore,
    jobs: int = -1,
    resume: bool = False,
    best: bool = False,
) -> Rollouts:
    """Roll out a fit, its baselines and the task's scripted policies from the same initial states.

    Writes ``rollouts.csv`` and ``videos/``, and adds ``rollouts`` to ``metrics.json``. After an interruption, finished
    methods are not played again.

    :param episodes: the number of initial states.
    :param film: the number of episodes of each method to film.
    :param resume: return the finished rollouts of the run where seeds and methods are the same.
    :param best: of the fitted models, roll out :attr:`Fit.best` alone.
    :returns: ``rollouts`` of the fit's metrics.
    :raises RunError: there is no task, or the fit has no folder.
    :raises Damaged: the file of an interrupted rollout is damaged.
    """
    folder = fit.run_folder
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    played = policies(fit, best)
    held = fit.metrics.rollouts
    whole = held and (held.seed, held.episodes, {*held.methods}) == (seeds.start, episodes, {*played})
    if held and whole and resume and all(_filmed(fit, name, seeds[:film]) for name in played):
        return held
    unfinished, total = folder / "rollouts.unfinished.json", len(played) * episodes
    rolled = _unfinished(unfinished, seeds)
    for name, policy in played.items():
        if name in rolled.outcomes and _filmed(fit, name, seeds[:film]):
            for _ in seeds:
                on_event(EpisodeEnded(name, total))
            continue
        outcomes = []
        for episode in run_episodes(str(fit.spec.task), policy, seeds, film, jobs, fit.spec.observed, ()):
            outcomes.append(episode.outcome)
            if episode.frames:
                write_film(_film(fit, name, episode.seed), episode, _names(policy))
            on_event(EpisodeEnded(name, total))
        rolled.outcomes[name] = outcomes
        write_text(unfinished, json_text(rolled.model_dump()))
    task, by_method = find_task(str(fit.spec.task)), {name: rolled.outcomes[name] for name in played}
    rows = [
        {"method": name, "seed": seed, **outcome}
        for name, outcomes in by_method.items()
        for seed, outcome in zip(seeds, outcomes, strict=True)
    ]
    write_table(folder / "rollouts.csv", dict.fromkeys(column for row in rows for column in row), rows)
    succeeded = {
        name: [outcome[SUCCESS] for outcome in outcomes]
        for name, outcomes in by_method.items()
        if all(SUCCESS in outcome for outcome in outcomes)
    }
    fit.metrics.rollouts = Rollouts(
        seed=seeds.start,
        episodes=episodes,
        methods={name: _method(task, name, outcomes, succeeded, fit.name) for name, outcomes in by_method.items()},
        worth=success_worth(fit.name, succeeded),
    )
    fit.metrics.write(folder)
    unfinished.unlink(missing_ok=True)
    return fit.metrics.rollouts


def _names(policy: Policy | str) -> list[Sequence[str]]:
    """The names of a controller's choices, lowest level first."""
    return list(policy.names.values()) if isinstance(policy, Controller) else []


def _film(fit: Fit, name: str, seed: int) -> Path:
    return fit.run_folder / "videos" / f"{name}-{seed}.mp4"


def _filmed(fit: Fit, name: str, seeds: Sequence[int]) -> bool:
    return all(_film(fit, name, seed).exists() for seed in seeds)


class _Unfinished(Record):
    """The outcomes of finished methods, kept in a file until all methods are finished."""

    models: str
    seeds: list[int]
    outcomes: dict[str, list[dict[str, OrNaN]]]

    @model_validator(mode="after")
    def _an_outcome_for_each_seed(self) -> _Unfinished:
        for method, outcomes in self.outcomes.items():
            if len(outcomes) != len(self.seeds):
                raise invalid(("outcomes", f"{method} has {len(outcomes)}, but there are {len(self.seeds)} seeds"))
        return self


def _unfinished(path: Path, seeds: Sequence[int]) -> _Unfinished:
    """The outcomes in a file where networks and seeds are the same; else none."""
    models = b"".join(model.read_bytes() for model in sorted(path.parent.rglob("model.safetensors")))
    fresh = _Unfinished(models=hashlib.sha256(models).hexdigest(), seeds=list(seeds), outcomes={})
    if not path.exists():
        return fresh
    kept = read_record(path, _Unfinished, f"remove it and roll out again: {command('rollout', path.parent)}")
    return kept if (kept.models, kept.seeds) == (fresh.models, fresh.seeds) else fresh


def _method(
    task: Task, name: str, outcomes: list[dict[str, float]], succeeded: Mapping[str, list[float]], ours: str
) -> Method:
    """The measures of a method, and its successes against ours."""
    found: dict[str, Any] = {"measures": summarize(task, outcomes)}
    if name != ours and {name, ours} <= {*succeeded}:
        found["against"] = paired_difference(succeeded[ours], succeeded[name])
    return Method.model_validate(found)
