"""The demonstrations a spec asks for, and what is known of their shapes before any work starts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch

from ddco_pyro.collect import OnDemonstration, collect
from ddco_pyro.control_dimensions import ControlDimension, all_constant, control_dimensions
from ddco_pyro.demonstrations import Demonstrations, DemonstrationsError, extent
from ddco_pyro.encoding import STEPS_AT_ONCE, Shapes
from ddco_pyro.hierarchy import Hierarchy
from ddco_pyro.initialize import POOLED
from ddco_pyro.memory import Extent, Work, refuse_too_much
from ddco_pyro.networks import ShapeError
from ddco_pyro.spec import BaselineSpec, Spec, SpecError, own_networks
from ddco_pyro.task import find_task


@dataclass(frozen=True)
class Dimensions:
    """Shapes of the observations by name, control dimensions A, and the longest demonstration where it is known.

    :param constant: the control dimensions that are constant in all demonstrations, and their values: they are no part
        of the model.
    :param control: what each control dimension does in the demonstrations; empty where that is not known.
    """

    shapes: Shapes
    control_size: int
    steps: int
    constant: Mapping[int, float] = field(default_factory=dict)
    control: tuple[ControlDimension, ...] = field(default=(), compare=False)

    @classmethod
    def of(cls, demonstrations: Demonstrations) -> Dimensions:
        """The dimensions of these demonstrations.

        :raises DemonstrationsError: every dimension of the control is constant.
        """
        control = control_dimensions(demo.actions for demo in demonstrations)
        constant = {one.number: one.minimum for one in control if one.constant}
        if len(constant) == len(control):
            raise DemonstrationsError(all_constant(control))
        shapes, size = demonstrations.observation_shapes, demonstrations.control_size
        return cls(shapes, size, max(demonstrations.lengths), constant, control)


def build_hierarchy(spec: Spec, dimensions: Dimensions) -> Hierarchy:
    """The spec's networks for these dimensions, randomly initialised.

    :raises SpecError: something in the spec does not fit the observations or the control.
    """
    missing = [one.key for one in spec.observations if one.key not in dimensions.shapes]
    if missing:
        known = ", ".join(sorted(dimensions.shapes))
        raise SpecError(f"observations: there is no {', '.join(missing)} (there are: {known})")
    scale = spec.control.scale
    if isinstance(scale, tuple) and len(scale) != dimensions.control_size:
        raise SpecError(
            f"control.scale: has {len(scale)} numbers, but the control has {dimensions.control_size} dimensions"
        )
    _refuse_giants(spec, dimensions)
    try:
        return Hierarchy(spec, dimensions.shapes, dimensions.control_size, dimensions.steps, dimensions.constant)
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
    if own_networks(spec):
        return  # its sizes are its own affair
    try:
        with torch.device("meta"):
            hierarchy = Hierarchy(spec, dimensions.shapes, dimensions.control_size, dimensions.steps)
    except ShapeError:
        return  # it is said better where the networks are made
    except (RuntimeError, MemoryError, TypeError):  # sizes that no tensor can have
        parameters = "more parameters than a machine can count"
    else:
        number = sum(parameter.numel() for parameter in hierarchy.parameters())
        if number <= MOST_PARAMETERS:
            return
        parameters = f"{number} parameters, more than {MOST_PARAMETERS}"
    raise SpecError(f"the networks have {parameters}; lower count, hidden, filters or kernel, or scale the images down")


def check_networks(spec: Spec, dimensions: Dimensions) -> Hierarchy:
    """The spec's networks, after those of its baselines were made too.

    :raises SpecError: something in the spec does not fit the observations or the control.
    """
    hierarchy = build_hierarchy(spec, dimensions)
    for number, baseline in enumerate(spec.compare_with):
        try:
            build_hierarchy(baseline_spec(spec, baseline), dimensions)
        except SpecError as error:  # what it shares with the spec is in order: it is about its own network
            raise SpecError(f"compare_with.{number}.{str(error).removeprefix('baseline.')}") from error
    return hierarchy


def baseline_spec(spec: Spec, baseline: BaselineSpec) -> Spec:
    """The spec of a baseline trained beside: the same but for the model."""
    return spec.model_copy(update={"hierarchy": None, "baseline": baseline, "compare_with": ()})


def dimensions(spec: Spec) -> Dimensions:
    """The dimensions of what the spec names, without collecting anything: from its file, or else from its task.

    A task that does not say how long its episodes are counts as having one step.
    """
    path = spec.demonstrations.path
    if spec.demonstrated_task is None or (path is not None and Path(path).exists()):
        return Dimensions.of(demonstrations(spec))
    task = find_task(spec.demonstrated_task)
    environment = task.load(spec.demonstrations.seed)
    try:
        shapes = {name: tuple(one.shape) for name, one in environment.observation_spec().items()}
        return Dimensions(shapes, environment.action_spec().shape[0], task.steps)
    finally:
        environment.close()


def parts(spec: Spec, demos: Demonstrations) -> dict[str, Demonstrations]:
    """The demonstrations to train with, ``train``, and those held out, ``valid``, left out where there are none."""
    if spec.demonstrations.valid_fraction == 0 and not demos.masks.keys() & {"train", "valid"}:
        return {"train": demos}
    train, valid = demos.split(spec.demonstrations.valid_fraction, spec.seed)
    return {"train": train, "valid": valid}


def demonstrations(spec: Spec, on_demonstration: OnDemonstration | None = None) -> Demonstrations:
    """The spec's demonstrations: read from its file, collected from its task's supervisor where there is none.

    :raises DemonstrationsError: the file is missing or wrong, lacks an observation or label that the spec names, or a
        fit to it would take more memory than is allowed.
    """
    own = spec.demonstrations
    path = Path(own.path) if own.path else None
    if spec.demonstrated_task is not None and (path is None or not path.exists()):
        path = collect(spec.demonstrated_task, own, path, on_demonstration)
    assert path is not None  # a spec has a task or a file
    _refuse_what_is_larger_than_memory(spec, path)
    labels = (own.labels,) if own.labels else ()
    return Demonstrations.read(path, [one.key for one in spec.observations], labels, own.exclude)


def _refuse_what_is_larger_than_memory(spec: Spec, path: Path) -> None:
    remedy = (
        "leave observations out, make its demonstrations fewer, shorter or equally long, scale pictures down, or lower "
        "filters or hidden"
    )
    what = f"{path}: a fit to {', '.join(one.key for one in spec.observations)}"
    refuse_too_much(memory_needed(spec, path), what, remedy)


def memory_needed(spec: Spec, path: Path) -> float:
    """Bytes that a fit of the spec and its baselines to a file of demonstrations takes, about, by the file's headers.

    :raises DemonstrationsError: the file cannot be read or does not hold what the spec names.
    """
    found = extent(path, [one.key for one in spec.observations], spec.demonstrations.exclude)
    models = [spec, *(baseline_spec(spec, baseline) for baseline in spec.compare_with)]
    works = [_work(model, found) for model in models]
    return found.fit(works, {f"obs/{one.key}" for one in spec.observations if one.differences})


def _work(spec: Spec, extent: Extent) -> Work:
    """What training the spec's model takes; what networks take is left out where they cannot be made."""
    shapes = {place.removeprefix("obs/"): shape for place, shape in extent.shapes.items() if place != "actions"}
    control = math.prod(extent.shapes["actions"])
    try:
        with torch.random.fork_rng(devices=[]):
            hierarchy = build_hierarchy(spec, Dimensions(shapes, control, max(extent.lengths)))
    except SpecError:  # it is said better where networks are checked
        return Work(spec.training.batch_size, STEPS_AT_ONCE, 0, 0)
    features = len(hierarchy.encoder.mean) + sum(shape[-1] * POOLED**2 for shape in hierarchy.encoder.images.values())
    kind = spec.training.initialize if hierarchy.depth else "random"
    clustered = {"random": 0, "vq": features, "vq_controls": features + control}[kind]
    return Work(spec.training.batch_size, hierarchy.steps_at_once, hierarchy.step_bytes, clustered)
