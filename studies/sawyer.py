"""Meta-World as the world of a study (``world: sawyer:WORLD``): an environment of its own, and the method
``bc_chunks``.

The environment is made in ``runs/metaworld/venv`` from ``arena_requirements.txt``; ``arena_metaworld.py`` runs in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from apart import Apart

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.spec import BaselineSpec, with_overrides
from ddco_pyro.study.cells import Job
from ddco_pyro.training.networks import Dimensions, baseline_spec

RUNS = Path(__file__).parents[1] / "runs" / "metaworld"
SIMULATOR = Apart("arena_metaworld.py", "arena_requirements.txt", RUNS)
NOISE = 0.1
"""Standard deviation of the noise on the expert's controls."""

CHUNK = 8
"""Steps of a chunk of actions."""

CHUNKS = {"kind": "flat", "policy": {"network": "mlp", "hidden": [256, 256]}}
"""The policy of ``bc_chunks``."""

REGRESSION: dict[str, Any] = {
    "control": {"kind": "gaussian", "std": 0.1},
    "training.optimizer": {"name": "adam", "lr": 1e-3},
    "training.batch_size": 4,
}
"""A Gaussian of fixed σ: its likelihood is the squared error, as in behaviour cloning."""


class MetaWorld:
    """Tasks of Meta-World v3 with their scripted experts."""

    def __init__(self) -> None:
        self.methods = {"bc_chunks": self.bc_chunks}

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the first successful episodes of the expert with noise on its controls."""
        SIMULATOR.collect(task, path, number=count, held_out=1, first=seeds.start, attempts=len(seeds), noise=NOISE)

    def play(self, task: str, fitted: Fit, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """Episodes of the exported policy: success, and its steps."""
        return self._play(task, fitted, starts, 1)

    def _play(self, task: str, fitted: Fit, starts: range, chunk: int) -> list[dict[str, float]]:
        played = SIMULATOR.played(task, {"policy": fitted}, chunk, first=starts.start, episodes=len(starts))
        return [{name: float(value) for name, value in one.items()} for one in played["episodes"]["policy"]]

    def bc_chunks(self, job: Job) -> dict[str, float]:
        """Behaviour cloning of chunks of actions, acting by temporal ensembling (ACT, Zhao et al. 2023)."""
        demos = chunked(job.demos, CHUNK)
        spec = with_overrides(job.spec, REGRESSION)
        spec = baseline_spec(spec, BaselineSpec.model_validate(CHUNKS), Dimensions.of(demos))
        fitted = fit(spec, demos, out=job.folder / "fit", keep=False)
        played = self._play(job.cell.task, fitted, job.starts, CHUNK)
        return {name: float(np.mean([episode[name] for episode in played])) for name in played[0]}


def chunked(demos: Demonstrations, chunk: int) -> Demonstrations:
    """The demonstrations with the controls of ``chunk`` steps as one control, [T, chunk · A]; the last one is repeated.

    >>> demo = Demonstration("demo", {"place": np.zeros((3, 1))}, np.array([[1.0], [2.0], [3.0]]))
    >>> chunked(Demonstrations((demo,)), 2)[0].actions.tolist()
    [[1.0, 2.0], [2.0, 3.0], [3.0, 3.0]]
    """

    def of(demo: Demonstration) -> Demonstration:
        steps = np.minimum(np.arange(len(demo))[:, None] + np.arange(chunk), len(demo) - 1)
        actions = demo.actions[steps].reshape(len(demo), -1)
        return Demonstration(demo.name, demo.observations, actions, demo.labels, demo.attributes)

    return Demonstrations(tuple(map(of, demos)), demos.masks, demos.attributes)


WORLD = MetaWorld()
