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
    :param selecting: the meta-policy is trained on the same choices, and the levels still have a uniform one.
    :param from_constants: networks take over what :class:`ddco_pyro.training.upper.Constants` say.
    """

    name: str
    discovering: int | None
    clamped: int | None
    trained: tuple[str, ...]
    selecting: bool = False
    from_constants: bool = False


def plan(spec: Spec, depth: int) -> list[Stage]:
    """The stages of training for D levels: from the lowest level up, the meta-policy last."""
    training = spec.training
    everything = ("trunk.", "levels.", "meta_policy.")
    if depth == 0:
        return [Stage("policy", None, None, everything)]
    stages: list[Stage] = []
    together = training.upper_levels == "segments" and depth > 1
    for level in range(1, 2 if together else depth + 1):
        own = (f"levels.{level - 1}.",) if level > 1 else ("trunk.", "levels.0.")
        if training.initialize != "random":
            kind = "parts" if training.initialize == "equal_parts" else "vq"
            if level == depth and _meta_policy_begins(spec):
                stages.append(Stage(f"{kind}-{level}", None, level, (*own, "meta_policy."), selecting=True))
            else:
                stages.append(Stage(f"{kind}-{level}", level, level, own))
        if training.layerwise:
            stages.append(Stage(f"level-{level}", level, None, own))
    if together:
        upper = (*(f"levels.{level}." for level in range(1, depth)), "meta_policy.")
        stages.append(Stage("segments", None, None, upper, from_constants=True))
        stages.append(Stage("upper", None, None, upper))
    elif training.layerwise:
        stages.append(Stage("meta-policy", None, None, ("meta_policy.",)))
    if not training.layerwise or training.lower_levels == "fine_tuned":
        stages.append(Stage("joint", None, None, everything))
    return stages


def _meta_policy_begins(spec: Spec) -> bool:
    """Whether the meta-policy is trained on the choices that the highest level is clamped to: where no stage trains it
    before all are trained together, and it does not act itself, of which clusters and parts say nothing.
    """
    assert spec.hierarchy is not None  # only levels are clamped
    return not spec.training.layerwise and "control" not in spec.hierarchy.meta_policy.emits
