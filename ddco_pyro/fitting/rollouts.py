"""Rollouts of a run: its model, its baselines and the task's scripted policies on the same initial states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ddco_pyro.acting.controller import Controller
from ddco_pyro.errors import BadInput
from ddco_pyro.events import Counted, OnEvent, ignore
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Method, Rollouts, Seeds, write_table
from ddco_pyro.names import method
from ddco_pyro.simulation.episodes import run_episodes, summarize
from ddco_pyro.simulation.film import write_film
from ddco_pyro.simulation.task import SUCCESS, Policy, find_task
from ddco_pyro.spec import with_overrides
from ddco_pyro.statistics import paired_difference, worth

FIRST_SEED = 1000
"""Seed of the first episode; each following episode adds 1."""


def policies(fit: Fit, best: bool = False) -> dict[str, Policy | str]:
    """The policies to roll out, by name: scripted ones, baselines, and the model itself last.

    :param best: of the fitted ones, :attr:`Fit.best` alone.
    :raises BadInput: the spec has no task, or names a scripted policy that the task lacks.
    """
    if fit.spec.task is None:
        raise BadInput(f"{fit.place}: its spec has no task, so there is nothing to roll out in")
    known = find_task(fit.spec.task).policies
    unknown = [name for name in fit.spec.rollout.policies if name not in known]
    if unknown:
        raise BadInput(
            f"rollout.policies: task {fit.spec.task!r} has no {', '.join(unknown)} (it has: "
            f"{', '.join(known)})"
        )
    scripted: dict[str, Policy | str] = {name: name for name in fit.spec.rollout.policies}
    if best:
        return scripted | {fit.best.name: fit.best.controller()}
    baselines = {name: other.controller() for name, other in fit.baselines.items()}
    return scripted | baselines | {fit.name: fit.controller()}


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

    Writes ``rollouts.csv`` and ``videos/``, and adds ``rollouts`` to ``metrics.json``.

    :param episodes: the number of initial states.
    :param film: the number of episodes of each method to film.
    :param resume: return the finished rollouts of the run where seeds and methods are the same.
    :param best: of the fitted models, roll out :attr:`Fit.best` alone.
    :returns: ``rollouts`` of the fit's metrics.
    :raises BadInput: there is no task, or the fit has no folder.
    """
    folder = fit.run_folder
    seeds = range(FIRST_SEED, FIRST_SEED + episodes)
    played = policies(fit, best)
    held = fit.metrics.rollouts
    whole = held and (held.seed, held.episodes, {*held.methods}) == (seeds.start, episodes, {*played})
    films = [_film(fit, name, seed) for name in played for seed in seeds[:film]]
    if held and whole and resume and all(film.exists() for film in films):
        return held
    by_method: dict[str, list[dict[str, float]]] = {}
    for name, policy in played.items():
        by_method[name] = []
        for episode in run_episodes(str(fit.spec.task), policy, seeds, film, jobs, fit.spec.observed, ()):
            by_method[name].append(episode.outcome)
            if episode.frames:
                # lowest level first
                names = [*policy.names.values()] if isinstance(policy, Controller) else []
                write_film(_film(fit, name, episode.seed), episode, names)
            on_event(Counted("rolling out", len(played) * episodes, method(name)))
    task = find_task(str(fit.spec.task))
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
    others = [name for name in succeeded if name != fit.name and fit.name in succeeded]
    pairs = {name: paired_difference(succeeded[fit.name], succeeded[name]) for name in others}
    fit.metrics.rollouts = Rollouts(
        seed=seeds.start,
        episodes=episodes,
        methods={
            name: Method(measures=summarize(task, outcomes), against=pairs.get(name))
            for name, outcomes in by_method.items()
        },
        worth=worth(fit.name, succeeded, paired_difference),
    )
    fit.metrics.write(folder)
    return fit.metrics.rollouts


def roll_out_repetitions(first: Fit, on_event: OnEvent = ignore, jobs: int = -1) -> None:
    """Roll out the repetitions of a fit from the initial states of its own rollouts.

    Adds ``rollouts.seeds`` to the fit's metrics: success rates by method, and the parts of the worth. A fit
    without repetitions stays as it is.
    """
    rollouts, seeds = first.metrics.rollouts, first.metrics.seeds
    if seeds is None or rollouts is None:
        return
    each = [rollouts]
    for again in first.repetitions:
        spec = with_overrides(again.spec, {"rollout.policies": []})  # scripts have no seeds
        alone = replace(again, spec=spec)
        each.append(roll_out(alone, rollouts.episodes, 0, on_event, jobs, resume=True))
    rates = {name: [one.success_rates[name].rate for one in each] for name in each[-1].success_rates}
    parts = [one.worth.parts if one.worth else {} for one in each]
    points = {
        part: [(own[part].only_ours - own[part].only_theirs) / rollouts.episodes for own in parts]
        for part in parts[0]
    }
    found = Seeds.model_validate({"training_seeds": seeds.training_seeds, "success": rates, "worth": points})
    first.metrics.rollouts = rollouts.model_copy(update={"seeds": found})
    first.metrics.write(first.run_folder)


def _film(fit: Fit, name: str, seed: int) -> Path:
    return fit.run_folder / "videos" / f"{name}-{seed}.mp4"
