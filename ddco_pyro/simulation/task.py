"""Interface of a task: an environment, scripted policies, and measures of success.

The library never imports a task. :func:`find_task` resolves an entry point of the group ``ddco_pyro.tasks``
or ``module:name`` to a :class:`Task`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

import numpy as np

from ddco_pyro.errors import BadInput, Failed, needing
from ddco_pyro.spec.base import TASKS

if TYPE_CHECKING:  # one's own demonstrations need no simulator
    import dm_env

    from ddco_pyro.simulation.cameras import Camera, Encoded

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
    """A task with a dm_env environment; :meth:`from_gymnasium` makes one from a Gymnasium environment.

    :param load: ``load(seed)`` makes a fresh environment; its first ``reset()`` depends on the seed alone.
    :param policies: ``make(environment)`` of each scripted policy, by name. Demonstrations are collected from
        the ``"supervisor"``. A policy may look at the environment's true state. Its optional attribute
        ``annotations`` (name to integer, for the step just decided) is stored as ground-truth labels. With an
        optional attribute ``intended`` [A] that control is recorded, and the disturbed control of ``act`` is
        executed.
    :param outcome: measures of the episode that just ended, such as ``{"success": 1.0, "accuracy_mm": 2.1}``;
        NaN for a measure that does not apply, such as the accuracy of an insertion that never happened.
    :param frame: a picture of the current scene, uint8 [H, W, 3].
    :param sources: files whose contents determine the demonstrations, for caching.
    :param steps: the largest number of control steps in an episode; 1 where unknown.
    :param measures: the kind of each measure in ``outcome``: a ``"rate"`` is 0 or 1 in every episode, a
        ``"mean"`` any number. By default ``success`` is a rate and every other measure a mean.
    :param cameras: cameras, and encoders of their pictures, by the name of their observation. A camera is
        drawn only where a spec observes it, because a picture takes longer than a step of simulation.
    :raises BadInput: ``measures`` has another kind, or calls ``success`` a mean.
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
        """Check the declared measures."""
        for name, kind in self.measures.items():
            if kind not in get_args(Kind):
                raise self._wrong(f"{name} is declared a {kind!r}; it has to be a 'rate' or a 'mean'")
        if self.kind(SUCCESS) != "rate":
            raise self._wrong(f"{SUCCESS} is a rate, by which methods are compared; call the mean otherwise")

    @classmethod
    def from_gymnasium(
        cls,
        id: str,
        policies: Mapping[str, Callable[[dm_env.Environment], Policy]] | None = None,
        sources: tuple[Path, ...] = (),
        **options: Any,
    ) -> Task:
        """The task of a registered Gymnasium environment (``pip install 'ddco-pyro[gymnasium]'``).

        Observations: a Box or Discrete space becomes ``state``, a Dict of them keeps its names. Controls: a
        Box is flattened to [A] and clipped to its bounds; a Discrete action is a control [1], rounded to the
        nearest action. Measures: ``success`` is ``info["is_success"]`` of the last step, or where there is
        none whether the episode was terminated rather than truncated; ``return`` is the sum of rewards.

        :param id: as in ``gymnasium.make``, such as ``"Pendulum-v1"`` or ``"module:Name-v0"``.
        :param policies: scripted policies; they find the Gymnasium environment as ``environment.gymnasium``.
        :param options: further ones of ``gymnasium.make``; films need ``render_mode="rgb_array"``.
        :raises BadInput: gymnasium or the environment's package cannot be imported, the environment is not
            registered, or a space has another type.
        """
        with needing("gymnasium", id):
            from ddco_pyro.simulation.gymnasium_environment import GymnasiumEnvironment
        example = GymnasiumEnvironment(id, 0, options)
        example.close()
        return cls(
            name=id.partition(":")[2] or id,
            load=lambda seed: GymnasiumEnvironment(id, seed, options),
            policies=policies or {},
            outcome=GymnasiumEnvironment.outcome,
            frame=GymnasiumEnvironment.frame,
            sources=sources,
            steps=example.steps,
            measures={"success": "rate", "return": "mean"},
        )

    def watched(self, seed: int, observed: Collection[str]) -> dm_env.Environment:
        """A fresh environment of ``load``, with pictures of the cameras in ``observed`` as observations."""
        names = self.seen_by_cameras(observed)
        if not names:
            return self.load(seed)
        from ddco_pyro.simulation.cameras import Watched

        return Watched(self.load(seed), {name: self.cameras[name] for name in names})

    def seen_by_cameras(self, observed: Collection[str]) -> list[str]:
        """The observations among ``observed`` that are pictures of this task's cameras."""
        return [name for name in self.cameras if name in observed]

    def kind(self, measure: str) -> Kind:
        """Whether a measure is a rate or a mean."""
        return self.measures.get(measure, "rate" if measure == SUCCESS else "mean")

    def measured(self, environment: dm_env.Environment) -> dict[str, float]:
        """The ``outcome`` of the episode that just ended.

        :raises BadInput: other measures than the declared ones, or a rate that is not 0, 1 or NaN.
        """
        outcome = {name: float(value) for name, value in self.outcome(environment).items()}
        if self.measures and outcome.keys() != self.measures.keys():
            names = f"{', '.join(outcome)}, and its measures are {', '.join(self.measures)}"
            raise self._wrong(f"its outcome has {names}; declare all of them")
        for name, value in outcome.items():
            if self.kind(name) == "rate" and not (value in (0.0, 1.0) or math.isnan(value)):
                why = "a rate is 0 or 1 in every episode"
                remedy = f"make it a mean, which {SUCCESS} cannot be"
                raise self._wrong(f"{name} is {value:g}, and {why}; {remedy}")
        return outcome

    def _wrong(self, what: str) -> BadInput:
        return BadInput(f"task {self.name!r}: {what}")


def find_task(name: str) -> Task:
    """The task registered under ``name``, or the one that ``module:name`` holds.

    :raises BadInput: the name is not registered, or the task cannot be imported; names a missing package.
    """
    registered = {point.name: point for point in entry_points(group=TASKS)}
    if name not in registered and ":" not in name:
        names = ", ".join(sorted(registered)) or "none"
        raise BadInput(f"no task is registered as {name!r} (registered: {names}); module:name works too")
    try:
        task: Any = registered[name].load() if name in registered else resolve_name(name)
    except Failed:  # such as missing OpenGL
        raise
    except ModuleNotFoundError as error:
        if str(error.name) in name.partition(":")[0]:
            raise BadInput(f"task {name!r} cannot be loaded: {error}") from error
        why = f"needs the package {error.name!r}, which is not installed here"
        raise BadInput(f"task {name!r} {why}") from error
    except Exception as error:  # whatever the task's code raises
        raise BadInput(f"task {name!r} cannot be loaded: {' '.join(str(error).split())}") from error
    if not isinstance(task, Task):
        kind = type(task).__name__
        raise BadInput(f"task {name!r} leads to a {kind}, not to a ddco_pyro.simulation.task.Task")
    return task
