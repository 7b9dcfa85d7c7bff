"""What training spent of its budget, and whether it had converged when the budget ended.

``training.epochs`` is a budget for all stages together, so that models compared have the same number of gradient steps
whatever their number of stages.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ddco_pyro.spec import TrainingSpec

RISING = 0.01
"""Nats per step. A stage whose tuning value rose by more than this over its last epochs has not converged."""

WINDOW = 20
"""How many epochs the last ones are where ``training.patience`` is null."""


@dataclass(frozen=True)
class StageEnd:
    """How a stage of training ended.

    :param epochs: passes over the training demonstrations that it made, of at most ``cap``; None for no limit.
    :param rising: nats per step by which the best tuning value rose over the last ``over`` of them
        (``training.patience``, or all where it made fewer): 0 where patience stopped it.
    """

    stage: str
    epochs: int
    cap: int | None
    rising: float
    over: int

    @property
    def converged(self) -> bool:
        """Whether it made epochs, and more of them promised little."""
        return self.epochs > 0 and self.rising <= RISING

    @classmethod
    def of(cls, stage: str, cap: int | None, tune: Sequence[float], patience: int | None) -> StageEnd:
        """From the tuning values: that from before the stage, and those of its epochs."""
        epochs = len(tune) - 1
        over = min(patience or WINDOW, epochs)
        return cls(stage, epochs, cap, max(tune) - max(tune[: epochs - over + 1]), over)


def share(budget: int | None, spent: int, stages_left: int) -> int | None:
    """A stage's cap: what is left of the budget, divided by the stages that are left; None without a budget."""
    return None if budget is None else (budget - spent) // stages_left


def summary(
    training: TrainingSpec,
    ends: Sequence[StageEnd],
    updates: int,
    best: int,
    epochs: Sequence[int],
    stopped: Mapping[int, int],
    diverged: Collection[int] = (),
) -> dict[str, Any]:
    """What ``metrics.json`` says of the training of the best restart, and of what all restarts took.

    :param updates: gradient steps in an epoch.
    :param best: the restart that the stages are of.
    :param epochs: of each restart, in all its stages.
    :param stopped: restarts that were stopped early, to their epochs of the last stage.
    :param diverged: restarts that ended because a log-likelihood became NaN or infinite.
    """
    spent = sum(end.epochs for end in ends)
    return {
        "budget": _effort(training.epochs, updates),
        "spent": _effort(spent, updates),
        "stages": [asdict(end) | {"converged": end.converged} for end in ends],
        "converged": ends[-1].converged,  # the last stage trains what acts in the end
        "restarts": {
            "best": best,
            "spent": _effort(sum(epochs), updates),
            "each": [
                {"epochs": count, "stopped": stopped.get(number)} | ({"diverged": True} if number in diverged else {})
                for number, count in enumerate(epochs)
            ],
        },
    }


def _effort(epochs: int | None, updates: int) -> dict[str, int | None]:
    return {"epochs": epochs, "gradient_steps": None if epochs is None else epochs * updates}


def effort(training: Mapping[str, Any] | None) -> str:
    """The gradient steps of a :func:`summary` and whether they were enough, for tables; runs of before have none."""
    if training is None:
        return "–"
    return f"{training['spent']['gradient_steps']}{'' if training['converged'] else ', not converged'}"
