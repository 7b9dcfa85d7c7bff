"""Settings of data, control and evaluation."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, InstanceOf, PlainSerializer

from ddco_pyro.spec.base import (
    Count,
    Items,
    Model,
    Positive,
    Problems,
    Seed,
    Share,
    Text,
    bare,
    invalid,
    nested,
    show,
)

EACH = "demonstration"
"""In place of an attribute in ``hold_out_by``: each demonstration is held out from a further fit."""

LabelNames = Annotated[Items[Text], Field(min_length=1)]
_LABELS = "a name, or a list with a name for each level"
Labels = Annotated[Text | LabelNames, nested((list, tuple), LabelNames, _LABELS)]


class DemonstrationsSpec(Model):
    """The demonstrations: read from a file, or collected from the task's supervisor."""

    path: Text | None = None
    """HDF5 file in robomimic's layout; null: demonstrations are collected in the task."""
    task: Text | None = None
    """Task in which demonstrations are collected; null: the spec's ``task``."""
    count: int = Field(default=100, ge=2)
    """Number of demonstrations to collect."""
    seed: Seed = 0
    """Seed of the first collected episode."""
    supervisor: Text = "supervisor"
    """Which of the task's scripted policies is recorded."""
    valid_fraction: Share = 0.1
    """Fraction of the demonstrations held out for validation, unless the file has ``mask/valid``; 0: none."""
    hold_out_by: Text | None = None
    """An attribute of demonstrations, such as the operator: all demonstrations with some of its values are
    held out, about ``valid_fraction`` of all, whatever masks the file has. The spec's ``seed`` draws the
    values. With ``demonstration``, every demonstration trains the model. Held-out results of a demonstration
    are then of a further fit without it. For few demonstrations; ``valid_fraction`` does not apply."""
    exclude: Items[Text] = ()
    """Names of demonstrations that are not read."""
    where: dict[str, Annotated[Items[Text], Field(min_length=1)]] = Field(default={})
    """Attributes of demonstrations and their values, such as ``{task: [reach]}``; others are not read."""
    labels: Labels | None = None
    """Ground-truth labels in the file, with which discovered options are compared: one name for all levels,
    or a list with a name for each level, lowest first. Steps labelled −1 are ignored."""

    def problems(self) -> Problems:
        if self.hold_out_by not in (None, EACH) and not self.valid_fraction:
            yield "hold_out_by", "holds out about valid_fraction, which is 0; raise valid_fraction"

    @property
    def file(self) -> Path | None:
        """The HDF5 file; None where the spec names none."""
        return Path(self.path) if self.path else None

    @property
    def validates(self) -> bool:
        """Whether there are held-out results, by the spec alone."""
        return self.holds_out_each or self.valid_fraction > 0

    @property
    def holds_out_each(self) -> bool:
        """Whether every demonstration trains the model, and each is held out from a further fit."""
        return self.hold_out_by == EACH

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names of all labels that the demonstrations must hold, without duplicates."""
        names = (self.labels,) if isinstance(self.labels, str) else self.labels or ()
        return tuple(dict.fromkeys(names))

    def labels_by_level(self, levels: int) -> tuple[str, ...]:
        """The name of each level's labels, lowest first; empty without labels."""
        return (self.labels,) * levels if isinstance(self.labels, str) else self.labels or ()


STEP = "step"
"""The built-in observation: number of the step divided by the steps of the longest training demonstration."""

TASK = "task"
"""The built-in observation: a number for each task of the demonstrations, 1 for its own, 0 for the others."""


Size = Annotated[Items[Count], Field(min_length=2, max_length=2)]
Part = Annotated[Items[Annotated[int, Field(ge=0)]], Field(min_length=4, max_length=4)]


class ObservationSpec(Model):
    """One observation that the networks read.

    Vectors are shifted and scaled to mean 0 and standard deviation 1 over the training demonstrations.
    Dimensions that are constant up to rounding are only shifted.
    """

    key: Text
    """Name of the observation in the demonstrations; ``step`` and ``task`` are built in."""
    minus: Text | None = None
    """For vectors: an observation of as many numbers that is subtracted, so that a position is relative to
    another. Networks know the difference as ``KEY-MINUS``."""
    differences: bool = False
    """Append x_t − x_{t−1}."""
    angles: Items[Annotated[int, Field(ge=0)]] = ()
    """For vectors: numbers, counted from 0, that are angles in radians. Each becomes its sine and cosine,
    behind the other numbers, so that nothing jumps where the angle does by 2π."""
    quaternions: Items[Annotated[int, Field(ge=0)]] = ()
    """For vectors: the first of each four numbers that are a unit quaternion, in either order. Each becomes
    the ten products of two of its numbers, of which rotation matrices consist, the same for q and −q."""
    bins: Annotated[int, Field(ge=0, le=64)] = 0
    """For vectors: bins of a piecewise-linear encoding, appended to each number and each difference. A bin
    holds the number clipped to one part of its range; the parts hold equally many distinct values. Networks
    can then read small differences within a wide range, such as those of nearly closed jaws."""
    crop: Part | None = None
    """For pictures: top, left, height and width of the crop, in the file's pixels; null: no crop."""
    resize: Size | None = None
    """For pictures: height and width after the crop is scaled by area averaging; null: not scaled."""
    shift: int = Field(default=0, ge=0)
    """For pictures, in training alone: the largest shift in pixels along either axis. In an epoch all
    pictures of a trajectory have the same shift; edge pixels are repeated."""

    def problems(self) -> Problems:
        if self.crop is not None and 0 in self.crop[2:]:
            yield "crop", "is top, left, height, width; height and width must be at least 1"
        for key in ("minus", "differences", "angles", "quaternions", "shift"):
            if self.key in (STEP, TASK) and getattr(self, key):
                yield key, f"does not apply to {self.key}; leave it out"
        turned = [*self.angles, *(first + place for first in self.quaternions for place in range(4))]
        if len(set(turned)) < len(turned):
            where = "angles" if self.angles else "quaternions"
            yield where, "name a number twice; each is part of one angle or quaternion"

    @property
    def name(self) -> str:
        """What networks call it."""
        return f"{self.key}-{self.minus}" if self.minus else self.key

    def turned(self, size: int) -> int:
        """For vectors: numbers of a step of ``size`` numbers, with angles and quaternions in their place."""
        return size + len(self.angles) + (10 - 4) * len(self.quaternions)

    @property
    def given(self) -> int:
        """For vectors: numbers before bins for each number of :meth:`turned`."""
        return 2 if self.differences else 1

    @property
    def seen(self) -> int:
        """For vectors: network inputs for each number of :meth:`turned`."""
        return self.given * (1 + self.bins)


Observation = Annotated[ObservationSpec, bare("key", str | ObservationSpec)]


class LearnedStd(Model):
    """A learned standard deviation σ, one for each level and control dimension."""

    learn: Literal[True]
    """Always true; for a fixed standard deviation give a number instead of this mapping."""
    floor: Positive = 0.01
    """Lower bound, in scaled units."""
    per_option: bool = False
    """Whether each option has its own σ. ``gaussian`` controls that often equal a bound or value let one
    option collect those steps, whatever the skill; ``clipped``, ``hurdle`` and ``binary`` controls do not."""
    per_state: bool = False
    """Whether σ depends on the observations: the policy's network outputs σ beside the mean. Each option, and
    a flat policy, has its own σ."""

    def problems(self) -> Problems:
        if self.per_option and self.per_state:
            yield "per_option", "per_state gives each option its own σ already; leave per_option out"


Std = Annotated[Positive | LearnedStd, nested((Mapping,), LearnedStd, "a positive number or {learn: true}")]

Kind = Literal["auto", "gaussian", "student", "clipped", "hurdle", "binary", "categorical"]
"""The kinds of distribution. Each has a class of its name in a module of its name in ``model/emissions``."""
DISCRETE = ("binary", "categorical")
"""The kinds without a σ."""


class DistributionSpec(Model):
    """The distribution of all control dimensions, or of some."""

    kind: Kind = "auto"
    """``gaussian``: unbounded; ``student``: heavy tails, those of Student's t with four degrees of freedom,
    which all dimensions of a step share; ``clipped``: a Gaussian censored at bounds; ``hurdle``: one exact
    value with some probability, else Gaussian or clipped; ``binary``: two values; ``categorical``: discrete
    actions, as integers; ``auto``: chosen for each dimension from the demonstrations and shown by ``check``,
    never ``student``."""
    std: Std | None = None
    """Standard deviation σ in scaled units, or ``{learn: true, floor: ...}``; null in a part: that of
    ``control.std``."""


class PartSpec(DistributionSpec):
    """Control dimensions with their own distribution."""

    name: Text
    """Name of the part."""
    dims: Annotated[Items[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    """Control dimensions, counted from 0."""

    def problems(self) -> Problems:
        if self.kind in DISCRETE and self.std is not None:
            yield "std", f"does not apply to kind: {self.kind}; leave it out"


class ControlSpec(DistributionSpec):
    """The distribution of the control."""

    std: Std = 0.1
    """Standard deviation σ in scaled units, or ``{learn: true, floor: ...}``. Continuous dimensions are
    scaled by their mean and spread in the training demonstrations."""
    relative_to: Text | None = None
    """An observation of as many numbers as the control, such as measured joints where the control is their
    targets. Options are of the control minus this observation. Controllers and exports give the control
    itself. Null: none."""
    power: float = Field(default=1.0, gt=0, le=1)
    """β: how many times the log-density of the control counts in training and in posteriors of the options (a
    power, or coarsened, likelihood). The less it counts, the longer segments are. Reported log-likelihoods
    are of densities."""
    parts: Items[PartSpec] = ()
    """Groups of dimensions with their own distribution; the settings above hold for all other dimensions."""

    @property
    def learned_stds(self) -> dict[str, LearnedStd]:
        """Every learned σ by its key path in the spec."""
        of_parts = {f"control.parts.{n}.std": part.std for n, part in enumerate(self.parts)}
        stds = {"control.std": self.std} | of_parts
        return {path: std for path, std in stds.items() if isinstance(std, LearnedStd)}

    def problems(self) -> Problems:
        dimensions: dict[int, str] = {}
        for number, part in enumerate(self.parts):
            if part.name in [other.name for other in self.parts[:number]]:
                yield f"parts.{number}.name", f"{part.name!r} is the name of another part too"
            for dimension in part.dims:
                if dimension in dimensions:
                    where = f"control dimension {dimension} is in {dimensions[dimension]!r} already"
                    yield f"parts.{number}.dims", where
                dimensions[dimension] = part.name


class SelectionSpec(Model):
    """Cross-validation over a grid."""

    folds: int = Field(default=10, ge=2)
    """Number of folds."""
    grid: dict[str, Annotated[Items[Any], Field(min_length=1)]] = Field(default={})
    """Key path in this spec to the values to try."""


OptionExecution = Literal["sample", "most_likely", "marginal"]


class RolloutSpec(Model):
    """How the fitted policy is rolled out in the task."""

    episodes: Count = 50
    """Number of episodes."""
    control: Literal["mean", "sample"] = "mean"
    """Whether the control is the mean of its distribution or a sample."""
    options: OptionExecution = "marginal"
    """``sample``: sample selections and terminations. ``most_likely``: take the likeliest of each.
    ``marginal``: act with the options of the largest filtered probability given all observations so far."""
    policies: Items[Text] = ()
    """Scripted policies of the task that are rolled out for comparison, such as ``open_loop``."""


SLICE = re.compile(r"\d{0,9}:\d{0,9}")


class PathSpec(NamedTuple):
    """Two or three numbers of an observation that are drawn as a path in space.

    :param key: name of the observation.
    :param numbers: which of its numbers, as a slice such as ``3:6``; None: the first three, or both of two.
    """

    key: str
    numbers: str | None = None

    def __str__(self) -> str:
        return self.key if self.numbers is None else f"{self.key}[{self.numbers}]"

    def among(self, size: int) -> list[int]:
        """The places of the path's numbers in a vector of ``size``: those of the slice that are within it."""
        ends = (self.numbers or ":3").split(":")
        return list(range(size)[slice(*(int(end) if end else None for end in ends))])


def _paths(value: Any) -> Any:
    several = isinstance(value, list | tuple) and not _is_pair(value)
    return tuple(_path(one) for one in (value if several else (value,)))


def _path(value: Any) -> PathSpec:
    if isinstance(value, str) and value:
        return PathSpec(value)
    if isinstance(value, PathSpec) or _is_pair(value):
        return PathSpec(*value)
    raise invalid(("", f"must be KEY or [KEY, slice], such as [pose, 3:6], got {show(value)}"))


def _written(paths: tuple[PathSpec, ...] | None) -> Any:
    return paths and [path.key if path.numbers is None else [*path] for path in paths]


def _is_pair(value: Any) -> bool:
    """Whether a value is ``[key, slice]``."""
    if not isinstance(value, list | tuple) or [isinstance(part, str) for part in value] != [True, True]:
        return False
    return SLICE.fullmatch(value[1]) is not None


Trajectory = Annotated[
    Items[InstanceOf[PathSpec]],
    Field(min_length=1),
    BeforeValidator(_paths, json_schema_input_type=str | list[str | list[str]]),
]


class ReportSpec(Model):
    """What the report shows."""

    trajectory: Annotated[Trajectory | None, PlainSerializer(_written)] = None
    """What is drawn as paths in space: an observation (its first three numbers, or both of two), ``[key,
    slice]``, or a list of these, one for each arm; null: nothing. ``init`` names the observation that
    controls move."""
