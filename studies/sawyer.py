"""Meta-World as the world of a study (``world: sawyer:WORLD``): an environment of its own.

The environment is made in ``runs/metaworld/venv`` from ``arena_requirements.txt``; ``arena_metaworld.py`` runs in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from apart import Apart
from policies import KINDS, Policy, Settings, fit

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.study.cells import Job

RUNS = Path(__file__).parents[1] / "runs" / "metaworld"
SIMULATOR = Apart("arena_metaworld.py", "arena_requirements.txt", RUNS)
NOISE = 0.1
"""Standard deviation of the noise on the expert's controls."""


class MetaWorld:
    """Tasks of Meta-World v3 with their scripted experts. Its own methods are the policies of ``policies.py``."""

    def __init__(self) -> None:
        self.methods = {name: partial(self._policy, settings) for name, settings in KINDS.items()}

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the first successful episodes of the expert with noise on its controls."""
        SIMULATOR.collect(task, path, number=count, held_out=1, first=seeds.start, attempts=len(seeds), noise=NOISE)

    def play(self, task: str, fitted: Fit | Policy, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """Episodes of the exported policy: success, and its steps."""
        played = SIMULATOR.played(task, {"policy": fitted}, first=starts.start, episodes=len(starts))
        return [{name: float(value) for name, value in one.items()} for one in played["episodes"]["policy"]]

    def _policy(self, settings: Settings, job: Job) -> dict[str, float]:
        """Train a policy and let it act; the cell may have other settings."""
        policy = fit(job.demos, settings.given(job.settings), job.cell.seed, job.spec.observed)
        played = self.play(job.cell.task, policy, job.starts, job.folder)
        return {name: float(np.mean([episode[name] for episode in played])) for name in played[0]}


WORLD = MetaWorld()
