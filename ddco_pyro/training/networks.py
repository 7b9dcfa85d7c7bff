"""The networks of a spec and of its baselines, for observations and a control of known dimensions."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn

from ddco_pyro.data.controls import refuse_unknown_dimensions
from ddco_pyro.model.encoder import Shapes
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy
from ddco_pyro.model.networks import ShapeError
from ddco_pyro.model.seeding import seeded
from ddco_pyro.names import HIERARCHY, MIXTURE
from ddco_pyro.spec import TASK, BaselineSpec, Spec, SpecError, user_code, with_overrides
from ddco_pyro.training.processes import device_of


def build_hierarchy(spec: Spec, dimensions: Dimensions, seed: int | None = None) -> Hierarchy:
    """The spec's networks for these dimensions, randomly initialised; torch's generator keeps its state.

    :param seed: of the initial weights; None for the spec's.
    :raises SpecError: something in the spec does not fit the observations or the control.
    """
    read = [*spec.observed, *([TASK] if spec.sees_task else [])]
    missing = [key for key in read if key not in dimensions.shapes]
    if missing:
        known = ", ".join(sorted(dimensions.shapes))
        raise SpecError(f"observations: there is no {', '.join(missing)} (there are: {known})")
    _refuse_undrawable(spec, dimensions.shapes)
    refuse_unknown_dimensions(spec.control, dimensions.control_size)
    try:
        with seeded(spec.seed if seed is None else seed):
            return Hierarchy(spec, dimensions)
    except ShapeError as error:
        raise SpecError(str(error)) from error


def _refuse_undrawable(spec: Spec, shapes: Shapes) -> None:
    drawn = spec.report.trajectory or ()
    counts = []
    for path in drawn:
        shape = shapes[path.key]
        counts.append(len(path.among(shape[0])) if len(shape) == 1 else 0)
        if counts[-1] not in (2, 3):
            raise SpecError(
                f"report.trajectory: {str(path)!r} is {counts[-1]} numbers, of shape {list(shape)} at each "
                "step; name two or three numbers of a vector, such as [KEY, 0:3]"
            )
    if len(set(counts)) > 1:
        raise SpecError(
            f"report.trajectory: {drawn[counts.index(2)]} is in the plane, {drawn[counts.index(3)]} in "
            "space; name as many numbers of each"
        )


MOST_PARAMETERS = 50_000_000
"""Of all networks together; each is held five times: weights, gradient, Adam's moments, the best so far."""

MOST_CHOICES = 10_000
"""Joint choices of all levels, Π(1 + k): inference has so many entries for every step of a demonstration."""


def check_networks(spec: Spec, dimensions: Dimensions) -> Hierarchy:
    """The spec's networks, made without weights unless there is user code among them, which needs some.

    A typing error in a size is refused before it fills the memory.

    :raises SpecError: something in the spec does not fit the observations, the control or this machine, or
        the model is larger than any that can be trained.
    """
    choices = math.prod(1 + level.count for level in spec.levels)
    if choices > MOST_CHOICES:
        raise SpecError(
            f"hierarchy.levels: the levels have {choices} joint choices, at most {MOST_CHOICES} can be "
            "summed over; lower count"
        )
    device_of(spec.training)
    if any(place.endswith(".network") for place in user_code(spec)):
        return build_hierarchy(spec, dimensions)
    try:
        with torch.device("meta"):
            hierarchy = build_hierarchy(spec, dimensions)
    except (RuntimeError, MemoryError, TypeError):  # sizes that no tensor can have
        size = "more parameters than a machine can count"
    else:
        if parameters(hierarchy) <= MOST_PARAMETERS:
            return hierarchy
        size = f"{parameters(hierarchy)} parameters, more than {MOST_PARAMETERS}"
    remedy = "lower count, hidden, filters or kernel, or scale the images down"
    raise SpecError(f"the networks have {size}; {remedy}")


def parameters(network: nn.Module) -> int:
    """The number of trained parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def model_name(spec: Spec) -> str:
    """The name of a model in tables: ``ddco``, or the kind of a baseline."""
    if spec.hierarchy is None:
        assert spec.baseline is not None  # a spec has one or the other
        return spec.baseline.kind
    memoryless = [level.name for level in spec.levels if not level.lasts]
    if not memoryless:
        return HIERARCHY
    return "_".join((MIXTURE, *(memoryless if len(memoryless) < len(spec.levels) else ())))


def check_models(spec: Spec, dimensions: Dimensions) -> dict[str, tuple[Spec, Hierarchy]]:
    """The specs and networks (:func:`check_networks`) of a model, which is first, and its baselines, by name.

    :raises SpecError: as :func:`check_networks`.
    """
    models = {model_name(spec): (spec, check_networks(spec, dimensions))}
    for number, (name, baseline) in enumerate(named_baselines(spec).items()):
        try:
            beside = baseline_spec(spec, baseline, dimensions)
            models[name] = beside, check_networks(beside, dimensions)
        except SpecError as error:  # what the baseline shares with the spec is in order
            problems = (problem.removeprefix("baseline.") for problem in error.problems)
            raise SpecError(*(f"compare_with.{number}.{problem}" for problem in problems)) from error
    return models


def named_baselines(spec: Spec) -> dict[str, BaselineSpec]:
    """The spec's baselines (``compare_with``) by name, numbered from the second model of one name on."""
    names: dict[str, BaselineSpec] = {}
    alone = spec.baseline.kind if spec.baseline else None
    for baseline in spec.compare_with:
        before = (baseline.kind == alone) + sum(other.kind == baseline.kind for other in names.values())
        names[f"{baseline.kind}_{before + 1}" if before else baseline.kind] = baseline
    return names


def baseline_spec(spec: Spec, baseline: BaselineSpec, dimensions: Dimensions) -> Spec:
    """The spec of a baseline: another model, with the optimiser and σ that the baseline names.

    Nothing else differs. A mixture keeps labels; policies without options have none.

    :raises SpecError: the network of a ``flat_equal`` does not fit the observations.
    """
    settings = baseline.optimizer.model_dump(exclude_unset=True) if baseline.optimizer else {}
    optimizer = {f"training.optimizer.{key}": value for key, value in settings.items()}
    model = baseline.model_dump(exclude_unset=True, exclude={"optimizer", "std"})
    std = baseline.std.model_dump(exclude_unset=True) if baseline.std else {}
    stds = {path: {"floor": old.floor} | std for path, old in spec.control.learned_stds.items() if std}

    def alone(**changes: Any) -> Spec:
        return with_overrides(spec, {"selection.grid": {}, "model": model | changes, **optimizer, **stds})

    if baseline.kind != "flat_equal":
        return alone()

    def resized(hidden: tuple[int, ...]) -> Spec:
        policy = baseline.policy.model_copy(update={"hidden": hidden})
        return alone(policy=policy.model_dump(exclude_unset=True))

    def count(hidden: tuple[int, ...]) -> int:
        with torch.device("meta"):
            return parameters(build_hierarchy(resized(hidden), dimensions))

    target = parameters(check_networks(spec, dimensions))
    return resized(nearest_widths(baseline.policy.hidden_sizes, target, count))


def nearest_widths(
    hidden: Sequence[int], target: int, parameters: Callable[[tuple[int, ...]], int]
) -> tuple[int, ...]:
    """Sizes of hidden layers, scaled by one factor, whose number of ``parameters`` is nearest to ``target``.

    Of two equally near ones the narrower is taken.
    """
    widest = max(hidden)

    def scaled(width: int) -> tuple[int, ...]:
        return tuple(max(1, round(size * width / widest)) for size in hidden)

    enough = 1 + bisect_left(range(1, MOST_PARAMETERS), target, key=lambda width: parameters(scaled(width)))
    return min(scaled(enough - 1), scaled(enough), key=lambda sizes: abs(parameters(sizes) - target))
