"""Many episodes of one fitted hierarchy at once: the networks see all of them in one pass for each step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import dm_env
import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import MostLikely
from ddco_pyro.model.ahmm import choose, complete
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.simulation.task import Task
from ddco_pyro.spec import RolloutSpec

Observations = Sequence[Mapping[str, np.ndarray]]


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
    """One episode from each seed, as a :class:`ddco_pyro.acting.controller.Controller` would act in it.

    Where options or controls are sampled, the draws belong to the group of seeds: another group, other draws.

    :param keep: names of the observations to keep.
    """
    environments = [task.load(seed) for seed in seeds]
    try:
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(np.random.SeedSequence(list(seeds)).generate_state(1)[0]))
            return _play(task, environments, Actors(hierarchy, spec, len(seeds)), seeds, keep)
    finally:
        for environment in environments:
            environment.close()


def _play(
    task: Task, environments: list[dm_env.Environment], actors: Actors, seeds: Sequence[int], keep: Sequence[str]
) -> list[Played]:
    steps = [environment.reset() for environment in environments]
    choices: list[list[np.ndarray]] = [[] for _ in steps]
    seen: list[dict[str, list[np.ndarray]]] = [{key: [] for key in keep} for _ in steps]
    while not all(step.last() for step in steps):
        controls = actors.act([step.observation for step in steps])
        active = actors.choices
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


class Actors:
    """N copies of one controller: :meth:`act` with an observation of each."""

    def __init__(self, hierarchy: Hierarchy, spec: RolloutSpec, size: int) -> None:
        self.hierarchy, self.spec, self.size = hierarchy.eval(), spec, size
        self.time = 0
        self._last: Observations | None = None
        self._choices: tuple[Tensor, ...] | None = None

    @property
    def choices(self) -> np.ndarray:
        """The active choices [N, D], lowest level first; 0 is control by the caller."""
        levels = self._choices or ()
        return np.stack([level.numpy() for level in levels], axis=1) if levels else np.zeros((self.size, 0), int)

    def act(self, observations: Observations) -> np.ndarray:
        """The controls [N, A], in the control's own units."""
        outputs = self.hierarchy(self._inputs(observations))
        self._choices = self._choose(outputs)
        self.time += 1
        return self.hierarchy.scaling.unscaled(self._control(outputs))

    def _inputs(self, observations: Observations) -> Inputs:
        """One sequence (last, now, last, now, ...) through the encoder: every second row has its own differences."""
        last = self._last or observations
        self._last = observations
        both = {
            key: np.stack([one[key] for pair in zip(last, observations, strict=True) for one in pair])
            for key in self.hierarchy.encoder.shapes
        }
        found = self.hierarchy.encoder.inputs([both])
        images = {key: image[0, 1::2, None] for key, image in found.images.items()}
        return Inputs(found.vector[0, 1::2, None], images, torch.tensor([self.time]))

    def _choose(self, outputs: Outputs) -> tuple[Tensor, ...]:
        actions = torch.zeros(self.size, 1, len(self.hierarchy.scaling.scale))
        tables = outputs.tables(actions, self.hierarchy.scaling.log_volume)
        now = complete(tables, torch.ones(self.size, dtype=torch.long)).steps()[0]
        if self.spec.options == "most_likely":
            with MostLikely():
                return choose(self.time, now, self._choices)
        return choose(self.time, now, self._choices)

    def _control(self, outputs: Outputs) -> Tensor:
        """The control of the lowest level whose choice is an option; else the meta-policy's."""
        rows = torch.arange(self.size)
        found = torch.zeros(self.size, len(self.hierarchy.scaling.scale))
        ones = torch.ones(self.size, dtype=torch.long)
        for decision, choices in zip(reversed(outputs.decisions), (ones, *reversed(self._choices or ())), strict=True):
            if decision.mean is None:
                continue
            mean = decision.mean[rows, 0, (choices - 1).clamp(min=0)]
            control = mean if self.spec.control == "mean" else torch.normal(mean, decision.std.expand_as(mean))
            found = torch.where((choices > 0).unsqueeze(-1), control, found)
        return found
