"""The registered tasks as the world of a study (``world: simulated:WORLD``), with the methods of ``policies.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from apart import Peers
from policies import Policy

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import run_episodes
from ddco_pyro.spec import DemonstrationsSpec

SUPERVISOR = {"pushing_cue": "scripted_noisy_0.3"}
"""The scripted policies that demonstrate, where it is another than ``supervisor``."""


class Simulated(Peers):
    """Registered tasks."""

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the supervisor."""
        how = {"count": count, "seed": seeds.start, "supervisor": SUPERVISOR.get(task, "supervisor")}
        collect(task, DemonstrationsSpec(**how), path)

    def play(self, task: str, fitted: Fit | Policy, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """The outcome of an episode from each start."""
        policy = fitted.controller() if isinstance(fitted, Fit) else fitted
        return [episode.outcome for episode in run_episodes(task, policy, starts, jobs=1, keep=())]


WORLD = Simulated()
