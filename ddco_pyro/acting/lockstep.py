"""Many episodes of one fitted hierarchy at once: the networks see all of them in one pass for each step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import dm_env
import numpy as np

from ddco_pyro.acting.controller import Controller
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.simulation.task import Task
from ddco_pyro.spec import RolloutSpec


@dataclass(frozen=True)
class Played:
    """One episode: the task's ``outcome``, the ``choices`` of each level [T, D], lowest first, and the ``observations``
    that were asked for, [T, ...] by name.
    """

    seed: int
    outcome: dict[str, float]
    choices: np.ndarray
    observations: dict[str, np.ndarray] = field(default_factory=dict)


def play(
    task: Task, hierarchy: Hierarchy, spec: RolloutSpec, seeds: Sequence[int], keep: Sequence[str] = ()
) -> list[Played]:
    """One episode from each seed, as a :class:`ddco_pyro.acting.controller.Controller` acts in it alone; of the task's
    cameras those that the hierarchy observes are drawn.

    :param keep: names of the observations to keep.
    """
    environments = [task.watched(seed, hierarchy.encoder.shapes) for seed in seeds]
    try:
        controller = Controller.from_spec(hierarchy, spec)
        controller.reset_all(seeds)
        return _play(task, environments, controller, seeds, keep)
    finally:
        for environment in environments:
            environment.close()


def _play(
    task: Task,
    environments: list[dm_env.Environment],
    controller: Controller,
    seeds: Sequence[int],
    keep: Sequence[str],
) -> list[Played]:
    steps = [environment.reset() for environment in environments]
    choices: list[list[np.ndarray]] = [[] for _ in steps]
    seen: list[dict[str, list[np.ndarray]]] = [{key: [] for key in keep} for _ in steps]
    while not all(step.last() for step in steps):
        controls = controller.act_all([step.observation for step in steps])
        active = controller.all_choices
        for number, step in enumerate(steps):
            if not step.last():
                choices[number].append(active[number])
                for key, values in seen[number].items():
                    values.append(np.array(step.observation[key]))
                steps[number] = environments[number].step(controls[number])
    return [
        Played(
            seed,
            task.measured(environment),
            np.stack(own),
            {key: np.stack(values) for key, values in kept.items()},
        )
        for seed, environment, own, kept in zip(seeds, environments, choices, seen, strict=True)
    ]
