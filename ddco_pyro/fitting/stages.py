"""The stages of training (SM 2.2, SM 2.3): what each trains, and how much of the hierarchy it sees."""

from __future__ import annotations

from dataclasses import dataclass

from ddco_pyro.spec import Spec


@dataclass(frozen=True)
class Stage:
    """One stage of training.

    :param discovering: train levels 1 to d under a uniform meta-policy; None for the whole hierarchy.
    :param clamped: the level whose choices are clamped to clusters or parts of the demonstrations; None for no level.
    :param trained: prefixes of the names of the parameters that are trained.
    """

    name: str
    discovering: int | None
    clamped: int | None
    trained: tuple[str, ...]


def plan(spec: Spec, depth: int) -> list[Stage]:
    """The stages of training for D levels: from the lowest level up, the meta-policy last."""
    training = spec.training
    everything = ("levels.", "meta_policy.")
    if depth == 0:
        return [Stage("policy", None, None, everything)]
    stages: list[Stage] = []
    for level in range(1, depth + 1):
        own = (f"levels.{level - 1}.",)
        if training.initialize != "random":
            kind = "parts" if training.initialize == "equal_parts" else "vq"
            stages.append(Stage(f"{kind}-{level}", level, level, own))
        if training.layerwise:
            stages.append(Stage(f"level-{level}", level, None, own))
    if training.layerwise:
        stages.append(Stage("meta-policy", None, None, ("meta_policy.",)))
    if not training.layerwise or training.lower_levels == "fine_tuned":
        stages.append(Stage("joint", None, None, everything))
    return stages
