"""The registered tasks as the world of a study (``world: simulated:WORLD``), with the methods of ``policies.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from policies import KINDS, Policy, Settings, fit

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import run_episodes
from ddco_pyro.spec import DemonstrationsSpec
from ddco_pyro.study.cells import Job

SUPERVISOR = {"pushing_cue": "scripted_noisy_0.3"}
"""The scripted policies that demonstrate, where it is another than ``supervisor``."""


class Simulated:
    """Registered tasks; a cell of one of the policies may have other settings than those of its kind."""

    def __init__(self) -> None:
        self.methods = {name: partial(self._policy, settings) for name, settings in KINDS.items()}

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the supervisor."""
        how = {"count": count, "seed": seeds.start, "supervisor": SUPERVISOR.get(task, "supervisor")}
        collect(task, DemonstrationsSpec(**how), path)

    def play(self, task: str, fitted: Fit | Policy, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """The outcome of an episode from each start."""
        policy = fitted.controller() if isinstance(fitted, Fit) else fitted
        return [episode.outcome for episode in run_episodes(task, policy, starts, jobs=1, keep=())]

    def _policy(self, settings: Settings, job: Job) -> dict[str, float]:
        policy = fit(job.demos, settings.given(job.settings), job.cell.seed, job.spec.observed)
        played = self.play(job.cell.task, policy, job.starts, job.folder)
        return {name: float(np.mean([outcome[name] for outcome in played])) for name in played[0]}


WORLD = Simulated()
