"""What a spec says beside the model and its training: data, control, evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, TypeAdapter, model_validator

from ddco_pyro.spec.messages import invalid
from ddco_pyro.spec.types import Count, Items, Model, Positive, Seed, Share, TaskName, Text, bare, nested

LabelNames = Annotated[Items[Text], Field(min_length=1)]
Labels = Annotated[
    Text | LabelNames,
    nested(
        (list, tuple),
        TypeAdapter(LabelNames, config=Model.model_config).validate_python,
        "a name, or a list with a name for each level",
    ),
]


class DemonstrationsSpec(Model):
    """Where the demonstrations come from: a file, or the task's supervisor."""

    path: Text | None = None
    """HDF5 file in robomimic's layout; without it they are collected in the task."""
    task: TaskName | None = None
    """Task in which they are collected, such as one whose episodes are single demonstrations; null: the spec's own."""
    count: int = Field(default=100, ge=2)
    """Number of demonstrations to collect."""
    seed: Seed = 0
    """Seed of the first collected episode."""
    supervisor: Text = "supervisor"
    """Which of the task's scripted policies is recorded."""
    valid_fraction: Share = 0.1
    """Part of the demonstrations held out for validation, where the file has no ``mask/valid``; 0 for none."""
    exclude: Items[Text] = ()
    """Names of demonstrations that are left out, whatever they hold."""
    labels: Labels | None = None
    """Ground-truth labels in the file with which the discovered options are compared: a name for every level, or a list
    with a name for each, the lowest level first. Steps labelled −1 are left out."""

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names of all labels that the demonstrations have to hold, each once."""
        names = (self.labels,) if isinstance(self.labels, str) else self.labels or ()
        return tuple(dict.fromkeys(names))

    def labels_by_level(self, levels: int) -> tuple[str, ...]:
        """The name of each level's labels, lowest first; nothing where there are none."""
        return (self.labels,) * levels if isinstance(self.labels, str) else self.labels or ()


STEP = "step"
"""The built-in observation: the number of the step divided by the steps of the longest training demonstration."""


class AugmentSpec(Model):
    """How an observation is varied while networks are trained, and at no other time."""

    shift: int = Field(default=0, ge=0)
    """Pictures alone: pixels, at most, by which all pictures of a trajectory are moved in an epoch, along either axis;
    the edge is repeated."""
    versions: Text | None = None
    """Vectors alone: the key of other versions of it, [T, V, ...], such as features of pictures that were moved. In an
    epoch all of a trajectory is seen as it is or as one of them, each equally likely."""


Size = Annotated[Items[Count], Field(min_length=2, max_length=2)]
Part = Annotated[Items[Annotated[int, Field(ge=0)]], Field(min_length=4, max_length=4)]


class ObservationSpec(Model):
    """One observation that the networks see."""

    key: Text
    """Name of the observation in the demonstrations; ``step`` is built in, and not read from them."""
    differences: bool = False
    """Append x_t − x_{t−1}."""
    standardize: bool = True
    """Shift and scale to mean 0 and standard deviation 1 over the training demonstrations; dimensions that vary by
    rounding alone, or not at all, are only shifted."""

    bins: Annotated[int, Field(ge=0, le=64)] = 0
    """Vectors alone: behind its numbers and their differences, each of them again as often as this, cut off at the
    ends of one of as many parts of its range, which hold as many different values each (a piecewise-linear encoding).
    So networks see what small differences say in a part of a wide range, as of jaws that are nearly closed, and what
    differs among the few steps in which a number is not 0."""

    crop: Part | None = None
    """Pictures alone: top, left, height and width of the part that is seen, in the file's pixels; null: all of it."""
    resize: Size | None = None
    """Pictures alone: height and width to which what is seen is scaled, by the mean over areas; null: as it is."""
    grey: bool = False
    """Pictures alone: whether red, green and blue become one luminance."""
    frames: Count = 1
    """Pictures alone: how many are seen together, the last one and those before it, along the channels; before the
    first step the first one is repeated. A single picture does not tell how fast anything moves."""
    augment: AugmentSpec | None = None
    """How it is varied in training; null: not at all."""

    @model_validator(mode="after")
    def _something_is_left(self) -> ObservationSpec:
        if self.crop is not None and 0 in self.crop[2:]:
            raise invalid(("crop", "is top, left, height, width; height and width must be 1 at least"))
        return self

    @model_validator(mode="after")
    def _steps_are_even(self) -> ObservationSpec:
        if self.key == STEP and self.differences:
            raise invalid(("differences", f"{STEP} grows by the same at each step; leave it out"))
        if self.key == STEP and self.augment:
            raise invalid(("augment", f"{STEP} is made from nothing that could be varied; leave it out"))
        return self

    @property
    def given(self) -> int:
        """Of a vector: how many numbers there are for each that is observed."""
        return 2 if self.differences else 1

    @property
    def seen(self) -> int:
        """Of a vector: how many numbers networks see for each that is observed."""
        return self.given * (1 + self.bins)


Observation = Annotated[ObservationSpec, bare("key", str | ObservationSpec)]


class LearnedStd(Model):
    """A standard deviation that is learned, one for each level and control dimension."""

    learn: Literal[True]
    """Always true; for a fixed standard deviation give a number instead of this mapping."""
    floor: Positive = 0.01
    """Lower bound, in scaled units."""
    per_option: bool = False
    """Whether each option has its own. With ``gaussian`` controls that sit on a bound or a value, one option may
    collect those steps, whatever the skill; ``clipped``, ``hurdle`` and ``binary`` ones are safe."""
    per_state: bool = False
    """Whether it depends on the observations: the policy's network gives it beside the mean. Each option, and a flat
    policy, has its own."""

    @model_validator(mode="after")
    def _one_of_both(self) -> LearnedStd:
        if self.per_option and self.per_state:
            raise invalid(("per_option", "per_state gives each option a σ of its own already; leave per_option out"))
        return self


Std = Annotated[
    Positive | LearnedStd, nested((Mapping,), LearnedStd.model_validate, "a positive number or {learn: true}")
]

ScaleName = Literal["standardize", "none"]
Scales = Annotated[Items[Positive], Field(min_length=1)]
Scale = Annotated[
    ScaleName | Scales,
    nested(
        (list, tuple),
        TypeAdapter(Scales, config=Model.model_config).validate_python,
        "standardize, none, or a list of positive numbers",
        get_args(ScaleName),
    ),
]

Kind = Literal["auto", "gaussian", "clipped", "hurdle", "binary", "categorical"]


class PartSpec(Model):
    """Dimensions of the control that have a distribution of their own."""

    name: Text
    """What the dimensions are called."""
    dims: Annotated[Items[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    """Which dimensions of the control, counted from 0."""
    kind: Kind = "auto"
    """As ``control.kind``."""
    std: Std | None = None
    """As ``control.std``, which null stands for."""
    scale: Scale | None = None
    """As ``control.scale``, which null stands for; a list has a number for each of these dimensions."""
    bounds: Annotated[Items[float], Field(min_length=2, max_length=2)] | None = None
    """``clipped`` and ``hurdle`` alone: the lower and the upper bound, in the control's own units; null: the extremes
    on which the demonstrations sit."""
    value: float | None = None
    """``hurdle`` alone: the value that each of these dimensions often has exactly; null: the commonest inside its
    range."""


class ControlSpec(Model):
    """The distribution of the control that a caller emits."""

    kind: Kind = "auto"
    """``gaussian``: free; ``clipped``: a Gaussian with bounds that it reaches; ``hurdle``: exactly one value with a
    probability, else free or clipped; ``binary``: a switch between two values; ``categorical``: discrete actions, as
    integers or rows with a single 1; ``auto``: decided for each dimension from the demonstrations, and shown by
    ``check``."""
    std: Std = 0.1
    """Standard deviation σ in scaled units, or ``{learn: true, floor: ...}``."""
    scale: Scale = "standardize"
    """``standardize`` (by the training demonstrations), ``none``, or one positive number for each control dimension,
    by which it is divided."""
    parts: Items[PartSpec] = ()
    """Groups of dimensions with a distribution of their own; what is in none of them is as above."""

    @property
    def learned_stds(self) -> dict[str, LearnedStd]:
        """Every σ that is learned, by its key path in the spec."""
        stds = {"control.std": self.std} | {f"control.parts.{n}.std": part.std for n, part in enumerate(self.parts)}
        return {path: std for path, std in stds.items() if isinstance(std, LearnedStd)}

    @model_validator(mode="after")
    def _disjoint(self) -> ControlSpec:
        dimensions: dict[int, str] = {}
        for number, part in enumerate(self.parts):
            if part.name in [other.name for other in self.parts[:number]]:
                raise invalid((f"parts.{number}.name", f"{part.name!r} is the name of another part too"))
            for dimension in part.dims:
                if dimension in dimensions:
                    where = f"control dimension {dimension} is in {dimensions[dimension]!r} already"
                    raise invalid((f"parts.{number}.dims", where))
                dimensions[dimension] = part.name
            if isinstance(part.scale, tuple) and len(part.scale) != len(part.dims):
                problem = f"has {len(part.scale)} numbers, but the part has {len(part.dims)} dimensions"
                raise invalid((f"parts.{number}.scale", problem))
            for setting in ("scale", "std"):
                if part.kind in ("binary", "categorical") and getattr(part, setting) is not None:
                    raise invalid((f"parts.{number}.{setting}", f"is of no use to kind: {part.kind}; leave it out"))
            if part.bounds is not None and part.kind not in ("clipped", "hurdle"):
                raise invalid((f"parts.{number}.bounds", "are for kind: clipped or hurdle"))
            if part.bounds is not None and part.bounds[0] >= part.bounds[1]:
                raise invalid((f"parts.{number}.bounds", "must be a lower and a higher number"))
            if part.value is not None and part.kind != "hurdle":
                raise invalid((f"parts.{number}.value", "is for kind: hurdle"))
            if part.value is not None and part.bounds and not part.bounds[0] < part.value < part.bounds[1]:
                raise invalid((f"parts.{number}.value", "must lie between the bounds"))
        return self


class InferenceSpec(Model):
    """How the latent variables are eliminated."""

    engine: Literal["fused", "enumerate"] = "fused"
    """``fused``: in one compiled pass; ``enumerate``: Pyro's enumeration. Both give the same numbers."""


class SelectionSpec(Model):
    """Cross-validation over a grid."""

    folds: int = Field(default=10, ge=2)
    """Number of folds."""
    grid: dict[str, Annotated[Items[Any], Field(min_length=1)]] = Field(default={})
    """Key path of this spec to the values to try there."""


OptionExecution = Literal["sample", "most_likely", "marginal"]


class RolloutSpec(Model):
    """How the fitted policy is tried in the task."""

    episodes: Count = 50
    """Number of episodes."""
    seed: Seed = 1000
    """Seed of the first episode; the next ones count up from it."""
    control: Literal["mean", "sample"] = "mean"
    """Whether the control is the mean of its distribution or a sample."""
    options: OptionExecution = "marginal"
    """``sample`` selections and terminations, take the ``most_likely`` of each, or act with the options of the largest
    ``marginal`` probability given all observations so far, in which small probabilities of having ended add up."""
    policies: Items[Text] = ()
    """Scripted policies of the task that are rolled out beside, such as ``open_loop``."""


class ReportSpec(Model):
    """What the report shows."""

    trajectory: Text | None = None
    """Observation whose first three numbers are drawn as trajectories in space; null: the one that moves the most."""
