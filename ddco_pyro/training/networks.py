"""The networks that a spec asks for, and those of its baselines, for observations and a control of known dimensions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from ddco_pyro.data.control_dimensions import ControlDimension, all_constant, control_dimensions
from ddco_pyro.data.control_parts import ControlPart, control_parts, refuse_unknown_dimensions
from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.model.encoding import Shapes
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import ShapeError
from ddco_pyro.model.seeding import seeded
from ddco_pyro.spec import BaselineSpec, Spec, SpecError, user_code, with_overrides
from ddco_pyro.training.devices import device_of
from ddco_pyro.training.widths import nearest_widths


@dataclass(frozen=True)
class Dimensions:
    """Shapes of the observations by name, control dimensions A, and the longest demonstration where it is known.

    :param constant: the control dimensions that are constant in all demonstrations, and their values: they are no part
        of the model.
    :param control: what each control dimension does in the demonstrations; empty where that is not known.
    :param parts: how a fitted model has the control; None where that is still to be decided.
    """

    shapes: Shapes
    control_size: int
    steps: int
    constant: Mapping[int, float] = field(default_factory=dict)
    control: tuple[ControlDimension, ...] = field(default=(), compare=False)
    parts: tuple[ControlPart, ...] | None = None

    @classmethod
    def of(cls, demonstrations: Demonstrations) -> Dimensions:
        """The dimensions of these demonstrations.

        :raises DemonstrationsError: every dimension of the control is constant.
        """
        control = control_dimensions(demo.actions for demo in demonstrations)
        constant = {dimension.number: dimension.minimum for dimension in control if dimension.constant}
        if len(constant) == len(control):
            raise DemonstrationsError(all_constant(control))
        shapes, size = demonstrations.observation_shapes, demonstrations.control_size
        return cls(shapes, size, max(demonstrations.lengths), constant, control)


def build_hierarchy(spec: Spec, dimensions: Dimensions, seed: int | None = None) -> Hierarchy:
    """The spec's networks for these dimensions, randomly initialised; torch's generator is left as it was.

    :param seed: of their numbers; None for the spec's.
    :raises SpecError: something in the spec does not fit the observations or the control.
    """
    missing = [key for key in spec.observed if key not in dimensions.shapes]
    if missing:
        known = ", ".join(sorted(dimensions.shapes))
        raise SpecError(f"observations: there is no {', '.join(missing)} (there are: {known})")
    drawn = spec.report.trajectory
    shape = dimensions.shapes[drawn] if drawn else (3,)
    if len(shape) != 1 or shape[0] < 3:
        raise SpecError(
            f"report.trajectory: {drawn!r} has shape {list(shape)} at each step; name a vector of three numbers or more"
        )
    scale = spec.control.scale
    if isinstance(scale, tuple) and len(scale) != dimensions.control_size:
        raise SpecError(
            f"control.scale: has {len(scale)} numbers, but the control has {dimensions.control_size} dimensions"
        )
    refuse_unknown_dimensions(spec.control, dimensions.control_size)
    _refuse_giants(spec, dimensions)
    try:
        with seeded(spec.seed if seed is None else seed):
            return _hierarchy(spec, dimensions)
    except ShapeError as error:
        raise SpecError(str(error)) from error


MOST_PARAMETERS = 50_000_000
"""Of all networks together. Training holds each five times: itself, its gradient, Adam's moments, the best so far."""

MOST_CHOICES = 10_000
"""Joint choices of all levels, Π(1 + k): every step of a demonstration has so many entries in the inference."""


def _refuse_giants(spec: Spec, dimensions: Dimensions) -> None:
    """A typing error in a size is refused before it fills the memory: networks are made without their numbers first.

    :raises SpecError: the model is larger than any that can be trained here.
    """
    choices = math.prod(1 + level.count for level in spec.hierarchy.levels) if spec.hierarchy else 1
    if choices > MOST_CHOICES:
        raise SpecError(
            f"hierarchy.levels: the levels have {choices} joint choices, at most {MOST_CHOICES} can be summed over; "
            "lower count"
        )
    if any(place.endswith(".network") for place in user_code(spec)):
        return  # its sizes are its own affair
    try:
        number = _counted(spec, dimensions)
    except ShapeError:
        return  # it is said better where the networks are made
    except (RuntimeError, MemoryError, TypeError):  # sizes that no tensor can have
        said = "more parameters than a machine can count"
    else:
        if number <= MOST_PARAMETERS:
            return
        said = f"{number} parameters, more than {MOST_PARAMETERS}"
    raise SpecError(f"the networks have {said}; lower count, hidden, filters or kernel, or scale the images down")


def _counted(spec: Spec, dimensions: Dimensions) -> int:
    """The number of parameters of the spec's networks, which are made without their numbers."""
    with torch.device("meta"):
        return parameters(_hierarchy(spec, dimensions))


def _hierarchy(spec: Spec, dimensions: Dimensions) -> Hierarchy:
    parts = dimensions.parts
    if parts is None and dimensions.control:
        parts = control_parts(spec.control, dimensions.control)
    size = dimensions.shapes, dimensions.control_size, dimensions.steps, dimensions.constant
    return Hierarchy(spec, *size, parts)


def parameters(network: nn.Module) -> int:
    """The number of trained parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def check_networks(spec: Spec, dimensions: Dimensions) -> Hierarchy:
    """The spec's networks, after those of its baselines were made too.

    :raises SpecError: something in the spec does not fit the observations, the control or this machine.
    """
    hierarchy = build_hierarchy(spec, dimensions)
    baselines(spec, dimensions)
    device_of(spec.training)
    return hierarchy


def baselines(spec: Spec, dimensions: Dimensions) -> list[tuple[Spec, Hierarchy]]:
    """The spec and the networks of each baseline that is trained beside.

    :raises SpecError: a baseline's network does not fit the observations.
    """
    built = []
    for number, baseline in enumerate(spec.compare_with):
        try:
            beside = baseline_spec(spec, baseline, dimensions)
            built.append((beside, build_hierarchy(beside, dimensions)))
        except SpecError as error:  # what it shares with the spec is in order: it is about its own network
            problems = (problem.removeprefix("baseline.") for problem in error.problems)
            raise SpecError(*(f"compare_with.{number}.{problem}" for problem in problems)) from error
    return built


def named_baselines(spec: Spec) -> dict[str, BaselineSpec]:
    """The baselines trained beside, by name, numbered from the second model of one name on: the spec's own counts."""
    names: dict[str, BaselineSpec] = {}
    own = spec.baseline.name if spec.baseline else None
    for baseline in spec.compare_with:
        before = (baseline.name == own) + sum(other.name == baseline.name for other in names.values())
        names[f"{baseline.name}_{before + 1}" if before else baseline.name] = baseline
    return names


def baseline_spec(spec: Spec, baseline: BaselineSpec, dimensions: Dimensions) -> Spec:
    """The spec of a baseline trained beside: another model, and the optimiser and σ that the baseline names; nothing
    else differs. A mixture keeps labels and durations; policies without options have neither.

    :raises SpecError: the network of a ``flat_equal`` does not fit the observations.
    """
    own = baseline.optimizer.model_dump(exclude_unset=True) if baseline.optimizer else {}
    optimizer = {f"training.optimizer.{key}": value for key, value in own.items()}
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

    build_hierarchy(resized(baseline.policy.hidden), dimensions)  # what is wrong with it is said here
    target = parameters(build_hierarchy(spec, dimensions))
    return resized(nearest_widths(baseline.policy.hidden, target, lambda hidden: _counted(resized(hidden), dimensions)))
