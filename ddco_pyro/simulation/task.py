"""What a task offers to the library: an environment, scripted policies for it, and how success is measured.

The library never imports a task. It finds one by the name of an entry point in the group ``ddco_pyro.tasks``
or by ``module:name``, and sees it only through :class:`Task`.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import dm_env
import numpy as np

from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.simulation.cameras import Camera, Encoded, Watched
from ddco_pyro.spec.base import TASKS

SUCCESS = "success"
"""The measure by which methods are compared."""

Kind = Literal["rate", "mean"]

Observation = Mapping[str, np.ndarray]


class Policy(Protocol):
    """Anything that acts: a scripted supervisor, the open-loop plan, a fitted controller."""

    def reset(self, seed: int) -> None:
        """Forget the last episode. Equal seeds give equal episodes."""

    def act(self, observation: Observation) -> np.ndarray:
        """The control for this observation, shape [A], in the task's own units."""


@dataclass(frozen=True)
class Task:
    """A task: ``load`` makes its environment, ``policies`` the scripted policies that act in it.

    :param load: ``load(seed)`` gives a fresh environment; its first ``reset()`` depends on the seed alone.
    :param policies: name to ``make(environment)``; a scripted policy may look at the environment's true state.
        ``"supervisor"`` is the one whose demonstrations are collected. A policy may have an attribute
        ``annotations`` (name to integer, for the step just decided): they are stored as ground-truth labels. One
        whose moves are disturbed may have an attribute ``intended`` [A], the control without the disturbance: it is
        recorded in place of the one that was executed (noise while collecting, clean labels).
    :param outcome: measures of the episode that just ended, such as ``{"success": 1.0, "accuracy_mm": 2.1}``;
        a measure that does not apply (the accuracy of an insertion that never happened) is NaN.
    :param frame: a picture of the scene as it is now, uint8 [H, W, 3].
    :param sources: the files whose contents decide what a demonstration looks like, for caching.
    :param steps: the most control steps that an episode can have, where that is known; 1 otherwise.
    :param measures: the kind of each measure in ``outcome``: a ``"rate"`` is 0 or 1 in every episode, a ``"mean"`` any
        number. Without it every measure is a mean but ``success``, which is always a rate.
    :param cameras: observations that are pictures, or what an encoder gives of them, by name. One is drawn where a spec
        observes it (:meth:`watched`), and nowhere else: a picture takes longer than a step of simulation.
    :raises OutcomeError: ``measures`` has another kind, or calls ``success`` a mean.
    """

    name: str
    load: Callable[[int], dm_env.Environment]
    policies: Mapping[str, Callable[[dm_env.Environment], Policy]]
    outcome: Callable[[dm_env.Environment], dict[str, float]]
    frame: Callable[[dm_env.Environment], np.ndarray]
    sources: tuple[Path, ...] = field(default=())
    steps: int = 1
    measures: Mapping[str, Kind] = field(default_factory=dict)
    cameras: Mapping[str, Camera | Encoded] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse a wrong declaration."""
        for name, kind in self.measures.items():
            if kind not in get_args(Kind):
                raise self._wrong(f"{name} is declared a {kind!r}; it has to be a 'rate' or a 'mean'")
        if self.kind(SUCCESS) != "rate":
            raise self._wrong(f"{SUCCESS} is a rate, by which methods are compared; call the mean otherwise")

    def watched(self, seed: int, observed: Collection[str]) -> dm_env.Environment:
        """A fresh environment as ``load`` makes it, whose observations also have what the cameras among ``observed``
        see.
        """
        cameras = {name: self.cameras[name] for name in self.seen_by_cameras(observed)}
        return Watched(self.load(seed), cameras) if cameras else self.load(seed)

    def seen_by_cameras(self, observed: Collection[str]) -> list[str]:
        """Those of some observations that are pictures of this task's cameras."""
        return [name for name in self.cameras if name in observed]

    def kind(self, measure: str) -> Kind:
        """Whether a measure is a rate or a mean."""
        return self.measures.get(measure, "rate" if measure == SUCCESS else "mean")

    def measured(self, environment: dm_env.Environment) -> dict[str, float]:
        """The ``outcome`` of the episode that just ended.

        :raises OutcomeError: it has other measures than were declared, or a rate that is not 0, 1 or NaN.
        """
        outcome = {name: float(value) for name, value in self.outcome(environment).items()}
        if self.measures and outcome.keys() != self.measures.keys():
            names = f"{', '.join(outcome)}, and its measures are {', '.join(self.measures)}"
            raise self._wrong(f"its outcome has {names}; declare all of them")
        for name, value in outcome.items():
            if self.kind(name) == "rate" and not (value in (0.0, 1.0) or math.isnan(value)):
                why = "a rate is 0 or 1 in every episode"
                raise self._wrong(f"{name} is {value:g}, and {why}; make it a mean, which {SUCCESS} cannot be")
        return outcome

    def _wrong(self, what: str) -> OutcomeError:
        return OutcomeError(f"task {self.name!r}: {what}")


class OutcomeError(BadInput):
    """What a task measures is not what it declares."""


class UnknownTask(BadInput):
    """No task of that name is registered, or ``module:name`` does not lead to a :class:`Task`."""


def package_of(name: str) -> str | None:
    """The package that registers a task under ``name``; None where ``module:name`` leads to it."""
    points = entry_points(group=TASKS, name=name)
    return next((point.dist.name for point in points if point.dist is not None), None)


def version_of(package: str | None) -> str | None:
    """The version of a package; None where there is none."""
    try:
        return None if package is None else importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def find_task(name: str) -> Task:
    """The task registered under ``name``, or the one that ``module:name`` holds.

    :raises UnknownTask: names what is registered.
    """
    registered = {point.name: point for point in entry_points(group=TASKS)}
    if name not in registered and ":" not in name:
        known = ", ".join(sorted(registered)) or "none"
        raise UnknownTask(f"no task is registered as {name!r} (registered: {known}); module:name works too")
    try:
        if name in registered:
            task: Any = registered[name].load()
        else:
            module, _, attribute = name.partition(":")
            task = getattr(importlib.import_module(module), attribute)
    except Failed:  # the task says itself what this machine lacks
        raise
    except Exception as error:  # whatever the task's code raises
        raise UnknownTask(f"task {name!r} cannot be loaded: {' '.join(str(error).split())}") from error
    if not isinstance(task, Task):
        raise UnknownTask(f"task {name!r} leads to a {type(task).__name__}, not to a ddco_pyro.simulation.task.Task")
    return task
