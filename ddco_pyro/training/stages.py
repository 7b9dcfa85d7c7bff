"""The stages of training (SM 2.2, SM 2.3): what each trains, its share of the budget, and how it ended.

``training.epochs`` is a budget for all stages together, so that models compared have the same number of
gradient steps whatever their number of stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ddco_pyro.spec import Spec, Start
from ddco_pyro.training.initialization import WAYS

RISING = 0.01
"""Nats per step. A stage whose tuning value rose by more than this over its last epochs has not converged."""

WINDOW = 20
"""The number of last epochs where ``training.patience`` is null."""

EVERYTHING = ("trunk.", "levels.", "meta_policy.")
"""Prefixes of the names of all parameters."""


@dataclass(frozen=True)
class Stage:
    """One stage of training.

    :param discovering: d trains levels 1 to d under a uniform meta-policy; None trains the whole hierarchy.
    :param clamped: the level whose choices are clamped to initial segments; None for no level.
    :param trained: prefixes of the names of the parameters that are trained.
    :param selecting: train the meta-policy on the clamped choices, beside the levels under a uniform one.
    :param from_constants: train the networks to :class:`ddco_pyro.training.upper.Constants`.
    :param memoryless: every option ends after every step (ψ = 1); later stages start networks of ψ at 1/2.
    """

    name: str
    discovering: int | None
    clamped: int | None
    trained: tuple[str, ...]
    selecting: bool = False
    from_constants: bool = False
    memoryless: bool = False


def starts_of(spec: Spec) -> tuple[Start | Literal["library"], ...]:
    """The ways in which the restarts of a model begin. A policy without options has random weights alone."""
    if spec.training.begins_at_library:
        return ("library",)
    starts: tuple[Start, ...] = spec.training.starts
    if spec.hierarchy is None:
        starts = tuple(start for start in starts if start == "random") or ("random",)
    return starts


def plan(spec: Spec, depth: int, restart: int = 0) -> list[Stage]:
    """The stages of training of a restart for D levels: from the lowest level up, the meta-policy last."""
    training = spec.training
    if depth == 0:
        return [Stage("policy", None, None, EVERYTHING)]
    if training.begins_at_library:
        return [Stage("joint", None, None, EVERYTHING)]
    stages: list[Stage] = []
    way = WAYS[starts_of(spec)[restart]]
    acts = spec.hierarchy is not None and "control" in spec.hierarchy.meta_policy.emits
    mixed = way.memoryless
    layerwise = bool(training.layerwise) and not mixed
    together = training.layerwise == "segments" and depth > 1 and not mixed
    for level in range(1, 2 if together else depth + 1):
        networks: tuple[str, ...] = (f"levels.{level - 1}.policy." if mixed else f"levels.{level - 1}.",)
        networks = networks if level > 1 else ("trunk.", *networks)
        if way.stage:
            name = f"{way.stage}-{level}"
            # clamped choices do not show when it acts itself
            if level == depth and not layerwise and not acts:
                trained = (*networks, "meta_policy.")
                stages.append(Stage(name, None, level, trained, selecting=True, memoryless=mixed))
            else:
                stages.append(Stage(name, level, level, networks, memoryless=mixed))
        if layerwise:
            stages.append(Stage(f"level-{level}", level, None, networks))
    if together:
        upper = (*(f"levels.{level}." for level in range(1, depth)), "meta_policy.")
        stages.append(Stage("segments", None, None, upper, from_constants=True))
        stages.append(Stage("upper", None, None, upper))
    elif layerwise:
        stages.append(Stage("meta-policy", None, None, ("meta_policy.",)))
    if mixed:
        policies = (f"levels.{number}.policy." for number in range(depth))
        stages.append(Stage("mixture", None, None, ("trunk.", *policies, "meta_policy."), memoryless=True))
    return [*stages, Stage("joint", None, None, EVERYTHING)]


def stage_end(
    stage: str, cap: int | None, tune: Sequence[float], patience: int | None, at_optimum: bool = False
) -> dict[str, Any]:
    """The end of a stage of training, as :class:`ddco_pyro.metrics.Stage`.

    ``rising`` are the nats per step by which the best tuning value rose over the last ``over`` epochs
    (``training.patience``, or all epochs where there are fewer): 0 where patience ended the stage, or at an
    optimum. The stage ``converged`` where it had epochs, and rose by at most :data:`RISING`.

    :param cap: the epochs that the stage might take; None for no limit.
    :param tune: tuning values before the stage, and of each epoch.
    """
    epochs = len(tune) - 1
    over = min(patience or WINDOW, epochs)
    rising = 0.0 if at_optimum else max(tune) - max(tune[: epochs - over + 1])
    end = {"stage": stage, "epochs": epochs, "cap": cap}
    return {**end, "rising": rising, "over": over, "converged": epochs > 0 and rising <= RISING}


def share(budget: int | None, spent: int, stages_left: int) -> int | None:
    """A stage's cap: the rest of the budget, divided by the stages that are left; None without a budget."""
    return None if budget is None else (budget - spent) // stages_left
