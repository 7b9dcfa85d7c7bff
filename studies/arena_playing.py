"""Plays an exported controller (``ddco-pyro export``) in an environment. Needs numpy alone."""

from __future__ import annotations

import argparse
import importlib.util
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

Observation = Mapping[str, np.ndarray]


class Environment(Protocol):
    """An episode's world; ``outcome`` is what else is measured of an episode, by name."""

    outcome: Mapping[str, float]

    def reset(self, seed: int) -> Observation:
        """Begin the episode of this seed."""
        ...

    def step(self, control: np.ndarray) -> tuple[Observation, bool, bool]:
        """The next observation, whether the task succeeded now, and whether the episode's time is up."""
        ...


def arguments(text: str | None, what: tuple[str, ...], number: int) -> argparse.ArgumentParser:
    """What scripts of simulators are told: ``WHAT TASK OUT NAME=EXPORTED...`` and options.

    :param text: what the help begins with.
    :param what: the commands there are.
    :param number: of demonstrations, where nothing else is said.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=what)
    parser.add_argument("task")
    parser.add_argument("out", type=Path)
    parser.add_argument("controllers", nargs="*", metavar="NAME=EXPORTED")
    parser.add_argument("--number", type=int, default=number)
    parser.add_argument("--held-out", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--first", type=int, help="the seed of the first episode")
    parser.add_argument("--attempts", type=int, help="to record episodes, at most")
    return parser


def named_controllers(named: Iterable[str]) -> dict[str, Any]:
    """The exported controllers of ``NAME=EXPORTED...``."""
    return {name: exported(folder) for name, _, folder in (pair.partition("=") for pair in named)}


def exported(folder: str | Path) -> Any:
    """The ``Runner`` of an exported controller, by the ``runner.py`` that was exported beside it.

    With a ``chunk.json`` beside it (:func:`write_chunk`), it gives chunks of actions (:class:`Chunks`).
    """
    path = Path(folder) / "runner.py"
    spec = importlib.util.spec_from_file_location("exported_runner", path)
    if spec is None or spec.loader is None or not path.exists():
        raise FileNotFoundError(f"{path}: no controller was exported there")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    beside = path.with_name("chunk.json")
    runner = module.Runner(folder)
    return Chunks(runner, **json.loads(beside.read_text())) if beside.exists() else runner


def write_chunk(folder: Path, chunk: int, executed: int) -> None:
    """Say of a controller in a folder that it gives chunks of actions."""
    (folder / "chunk.json").write_text(json.dumps({"chunk": chunk, "executed": executed}))


class Chunks:
    """Acts by a controller of chunks of actions, which sees every observation.

    :param chunk: steps of a chunk.
    :param executed: steps of a chunk that are executed before another one. 0: each step has the mean of what
        the last chunks say of it, the older the heavier (temporal ensembling: ACT, Zhao et al. 2023).
    """

    DECAY = 0.01

    def __init__(self, controller: Any, chunk: int, executed: int = 0) -> None:
        self.controller, self.chunk, self.executed = controller, chunk, executed

    def reset(self, seed: int = 0) -> None:
        """Forget the last episode."""
        self.controller.reset(seed)
        self.chunks: list[np.ndarray] = []
        self.steps = 0

    def act(self, observation: Observation) -> np.ndarray:
        """The control for this observation, [A]."""
        given, step = self.controller.act(observation).reshape(self.chunk, -1), self.steps
        self.steps += 1
        if self.executed:
            place = step % self.executed
            self.chunks = self.chunks if place else [given]
            return np.asarray(self.chunks[0][place])
        self.chunks = [*self.chunks, given][-self.chunk :]
        newest = len(self.chunks) - 1
        said = np.stack([own[newest - number] for number, own in enumerate(self.chunks)])
        weights = np.exp(-self.DECAY * np.arange(len(said)))
        return np.asarray(weights @ said / weights.sum())


def play(controller: Any, environment: Environment, seed: int) -> dict[str, Any]:
    """One episode: it ends when the task has succeeded, or when its time is up."""
    observation = environment.reset(seed)
    controller.reset(seed)
    success = ended = False
    steps = 0
    while not (success or ended):
        observation, success, ended = environment.step(controller.act(observation))
        steps += 1
    return {"success": success, "steps": steps, **environment.outcome}


def play_all(environment: Environment, out: Path, controllers: Mapping[str, Any], seeds: range) -> None:
    """Episodes of each controller, as JSON."""
    played = {name: [play(one, environment, seed) for seed in seeds] for name, one in controllers.items()}
    out.write_text(json.dumps({"episodes": played}))
