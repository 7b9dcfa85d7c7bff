"""What a comparison of runs holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ddco_pyro.errors import BadInput


class CompareError(BadInput):
    """Runs that cannot be compared."""


@dataclass(frozen=True)
class Row:
    """One run, in nats over all held-out trajectories.

    Every error is that of :func:`ddco_pyro.evaluation.analysis.paired` times the steps: how much the number per step
    varies with the demonstrations that happen to be held out, for one fit of each run.

    :param total: Σ log p(ξ_n), and its standard error ``se``.
    :param difference: the best run's total minus this one's (0 for the best), and its standard error ``dse``: smaller
        than what the two ``se`` suggest, as the trajectories are the same.
    :param each: log p(ξ_n) of every trajectory.
    """

    rank: int
    name: str
    model: str
    parameters: int
    total: float
    se: float
    difference: float
    dse: float
    per_step: float
    each: tuple[float, ...]
    training: Mapping[str, Any] | None


@dataclass(frozen=True)
class Comparison:
    """Rows, the best first; the ``trajectories`` they were compared on and their ``steps``; how well options agree with
    labels on them; rollouts paired by initial state; and the run whose likelihood sorts the trajectories: the best with
    options, or the best.
    """

    rows: Sequence[Row]
    trajectories: Sequence[str]
    steps: Sequence[int]
    agreement: Sequence[dict[str, Any]]
    rollouts: Sequence[dict[str, Any]]
    sorted_by: str

    @property
    def worst_first(self) -> list[dict[str, Any]]:
        """Every trajectory with its log-likelihood per step under each run, the least likely first."""
        listed = [
            {
                "name": name,
                "steps": steps,
                "log_likelihood_per_step": {row.name: row.each[place] / steps for row in self.rows},
            }
            for place, (name, steps) in enumerate(zip(self.trajectories, self.steps, strict=True))
        ]
        return sorted(listed, key=lambda demonstration: demonstration["log_likelihood_per_step"][self.sorted_by])

    def as_data(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "trajectories": list(self.trajectories),
            "steps": sum(self.steps),
            "demonstrations": self.worst_first,
            "rows": [vars(row) | {"each": list(row.each)} for row in self.rows],
            "agreement": list(self.agreement),
            "rollouts": list(self.rollouts),
        }
