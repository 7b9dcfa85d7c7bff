"""Registered tasks as the world of a study (``world: simulated:WORLD``), with methods of ``policies.py``."""

from __future__ import annotations

from pathlib import Path

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import run_episodes
from ddco_pyro.spec import DemonstrationsSpec
from studies.apart import Episodes, Peers
from studies.policies import Policy

RECORDED = {
    "pushing": ("pushing_goal", "scripted_noisy_0.3", ()),
    "pushing_cue": ("pushing_cue", "scripted_noisy_0.3", ()),
    "bin_picking": ("bin_picking", "supervisor", ("image",)),
}
"""The task, the scripted policy and the cameras of demonstrations, where not the task's supervisor alone."""


class Simulated(Peers):
    """Registered tasks, of installed packages or ``module:name``."""

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Record the supervisor."""
        recorded, supervisor, cameras = RECORDED.get(task, (task, "supervisor", ()))
        how = {"count": count, "seed": seeds.start, "supervisor": supervisor}
        collect(recorded, DemonstrationsSpec(**how), path, observed=cameras)

    def play(self, task: str, fitted: Fit | Policy, starts: range, folder: Path) -> Episodes:
        """The outcome of an episode from each start."""
        is_fit = isinstance(fitted, Fit)
        policy, observed = (fitted.controller(), fitted.spec.observed) if is_fit else (fitted, ())
        return [episode.outcome for episode in run_episodes(task, policy, starts, 0, 1, observed, ())]


WORLD = Simulated()
