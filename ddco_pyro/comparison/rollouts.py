"""Rollouts of different runs from the same initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ddco_pyro.evaluation.schema import read_successes
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.simulation.episodes import paired_difference, rate

Outcomes = Mapping[int, float]
"""Success (1) or not (0) by the seed of the initial state."""


def paired_rollouts(fits: Sequence[Fit], order: Sequence[str]) -> list[dict[str, Any]]:
    """Success of each run against the first in ``order`` that was rolled out, on the initial states that both have.

    Runs of other tasks, or without rollouts, are left out. ``p_value`` is McNemar's exact one.
    """
    by_name = {str(fit): fit for fit in fits}
    known = {name: own for name in order if (own := _outcomes(by_name[name]))}
    if len(known) < 2:
        return []
    first, *others = known
    alike = [name for name in others if by_name[name].spec.task == by_name[first].spec.task]
    return [pair for name in alike if (pair := _pair(first, known[first], name, known[name]))["trials"]]


def _pair(first: str, ours: Outcomes, second: str, theirs: Outcomes) -> dict[str, Any]:
    seeds = sorted(ours.keys() & theirs.keys())
    left, right = [ours[seed] for seed in seeds], [theirs[seed] for seed in seeds]
    rates = {"rate": rate(int(sum(left)), len(left)), "other_rate": rate(int(sum(right)), len(right))}
    return {"run": first, "other": second, **paired_difference(left, right), **rates}


def _outcomes(fit: Fit) -> Outcomes:
    """What ``rollout`` wrote: for a baseline into the folder of the run that it belongs to."""
    folder = fit.run_folder.resolve()
    run = folder.parent.parent
    tables = [(folder, fit.name), *([(run, folder.name)] if folder.parent == run / "baselines" else [])]
    for place, name in tables:
        own = {seed: value for (method, seed), value in read_successes(place).items() if method == name}
        if own:
            return own
    return {}
