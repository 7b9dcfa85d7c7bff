"""What a task offers to the library: an environment, scripted policies for it, and how success is measured.

The library never imports a task. It finds one by the name of an entry point in the group ``ddco_pyro.tasks``
or by ``module:name``, and sees it only through :class:`Task`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import dm_env
import numpy as np

from ddco_pyro.errors import BadInput
from ddco_pyro.spec.types import TASKS

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
    """

    name: str
    load: Callable[[int], dm_env.Environment]
    policies: Mapping[str, Callable[[dm_env.Environment], Policy]]
    outcome: Callable[[dm_env.Environment], dict[str, float]]
    frame: Callable[[dm_env.Environment], np.ndarray]
    sources: tuple[Path, ...] = field(default=())
    steps: int = 1


class UnknownTask(BadInput):
    """No task of that name is registered, or ``module:name`` does not lead to a :class:`Task`."""


def find_task(name: str) -> Task:
    """The task registered under ``name``, or the one that ``module:name`` holds.

    :raises UnknownTask: names what is registered.
    """
    registered = {point.name: point for point in entry_points(group=TASKS)}
    if name in registered:
        found: Any = registered[name].load()
    elif ":" in name:
        module, _, attribute = name.partition(":")
        try:
            found = getattr(importlib.import_module(module), attribute)
        except Exception as error:  # whatever the user's code raises
            raise UnknownTask(f"task {name!r} cannot be loaded: {error}") from error
    else:
        known = ", ".join(sorted(registered)) or "none"
        raise UnknownTask(f"no task is registered as {name!r} (registered: {known}); module:name works too")
    if not isinstance(found, Task):
        raise UnknownTask(f"task {name!r} leads to a {type(found).__name__}, not to a ddco_pyro.task.Task")
    return found
