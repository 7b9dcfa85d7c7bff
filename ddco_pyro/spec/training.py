"""How a spec has a model trained: optimiser, stages, when to stop, labels and durations."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, TypeAdapter, model_validator

from ddco_pyro.spec.messages import invalid
from ddco_pyro.spec.types import Count, Fraction, Items, Model, Positive, Seed, Share, Text, nested


class RidgeSpec(Model):
    """Ridges of EM: precisions of a normal prior on the weights of linear maps, biases left out."""

    policy: float = Field(default=1.0, ge=0)
    """Of the means of controls: as many steps, of observations with unit variance, that say 0; in units of 1/σ²."""
    gate: float = Field(default=1.0, ge=0)
    """Of logits: of options, switches and discrete actions."""
    termination: float = Field(default=1.0, ge=0)
    """Of terminations."""


class OptimizerSpec(Model):
    """The optimiser of the expectation-gradient steps."""

    name: Literal["adam", "adamw", "momentum", "em"] = "adam"
    """``adam``, ``adamw``, ``momentum`` for gradient descent with momentum, or ``em`` for expectation-maximisation,
    where every network is linear."""
    ridge: RidgeSpec = RidgeSpec()
    """Ridges (``em`` only)."""
    lr: Positive = 1e-3
    """Learning rate."""
    schedule: Literal["constant", "cosine"] = "constant"
    """``cosine``: in each stage the learning rate falls to 0 at the last epoch that its budget allows, along half a
    cosine; it needs ``training.epochs``."""
    warmup: int = Field(default=0, ge=0)
    """Epochs at the beginning of each stage over which the learning rate rises to its value."""
    momentum: Share = 0.9
    """Momentum (``momentum`` only)."""
    weight_decay: float = Field(default=0.0, ge=0)
    """L2 penalty; of ``adamw`` by which part, times the learning rate, every weight shrinks in a step."""

    @model_validator(mode="after")
    def _momentum_has_its_optimizer(self) -> OptimizerSpec:
        if self.name != "momentum" and self.momentum != type(self).model_fields["momentum"].default:
            raise invalid(("momentum", f"is for name: momentum, and {self.name} would not use it; leave it out"))
        return self


class LabelsSpec(Model):
    """Labels of demonstrations that say which option of a level is active; at steps where a label is -1 it is free."""

    model_config = ConfigDict(serialize_by_alias=True)

    level: Text
    """Name of the level."""
    source: Text = Field(alias="from")
    """Name of the labels in the file, integers: those from 0 on, sorted, are the options 1, 2, ..."""
    count: Count | None = None
    """Number of demonstrations whose labels are used: the first ones in training, those to tune with last; null: all.
    Those of held-out demonstrations never are."""
    hold: bool = True
    """Whether labels say which option is active in all of training; false: in initialisation alone."""


Duration = Annotated[float, Field(ge=1)]
Durations = Annotated[Items[Duration], Field(min_length=1)]


class DurationSpec(Model):
    """A prior on how long options last: a Beta distribution of each option's probability ψ to terminate at a step."""

    mean: Annotated[
        Duration | Durations,
        nested(
            (list, tuple),
            TypeAdapter(Durations, config=Model.model_config).validate_python,
            "a number of steps, at least 1, or a list of them",
        ),
    ]
    """Steps that an option lasts on average, 1 / E[ψ]; a list has one for each level, lowest first. A level above the
    lowest counts the options below it that end instead."""
    weight: float = Field(default=1.0, ge=0, le=1e30)
    """How many selections of each option the prior counts as, beside those in the training demonstrations; 0 for no
    prior."""


class TrainingSpec(Model):
    """How the model is trained."""

    initialize: Literal["vq", "vq_controls", "equal_parts", "random"] = "vq"
    """``vq``: by vector quantisation of the observations that the options' policies read (SM 2.2); ``vq_controls``: of
    these and controls; ``equal_parts``: each demonstration cut into as many parts of equal length as there are options,
    for skills that follow one another; ``random``: random weights."""
    layerwise: bool = True
    """Discover level after level, lowest first, rather than all at once."""
    upper_levels: Literal["clusters", "segments"] = "clusters"
    """How levels above the lowest are discovered, layer by layer: ``clusters``: each as the lowest is, after the one
    below it; ``segments``: all together, from which options of the lowest level follow each other."""
    lower_levels: Literal["fine_tuned", "frozen"] = "fine_tuned"
    """Layer-wise training: whether a last stage trains all levels together, or what was discovered stays as it is."""
    optimizer: OptimizerSpec = OptimizerSpec()
    """The optimiser."""
    epochs: Count | None = 800
    """Passes over the training demonstrations in all stages together, at most: the same budget of gradient steps for
    every model, whatever its number of stages. A stage may take an even share of what is left; null for no limit but
    patience."""
    average: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Decay, in every gradient step of a stage, of the running mean of the weights that is evaluated and kept in the
    place of the last weights; null for the last ones."""
    batch_size: Count = 16
    """Trajectories in each gradient step."""
    shards: Count = 1
    """Parts of a minibatch, which at most as many processes may share (``fit --processes``). Results depend on this
    number, by rounding and by what dropout draws, and not on that of processes."""
    restarts: Count = 1
    """Independent initialisations; the best on the tuning demonstrations is kept."""
    halving: Count | None = 50
    """With more restarts: epochs of the last stage after which the worse half of them, on the tuning demonstrations, is
    stopped; of those that are left again after twice as many, and so on. Null: all are trained to the end."""
    seed: Seed | None = None
    """Seed of what is random in training: first weights, clusters, the order of demonstrations, dropout; null: that of
    the spec. What is held out or tuned on does not depend on it."""
    tune_fraction: Fraction = 0.1
    """Part of the training demonstrations set aside for tuning: to stop early and to choose among restarts."""
    tune_by: Literal["mean", "median"] = "mean"
    """What of the tuning demonstrations decides: the ``mean`` over their steps of what is maximised, or the ``median``
    over demonstrations, which one odd demonstration among a few cannot decide."""
    patience: Count | None = 20
    """Epochs without improvement before a stage stops; null for never."""
    workers: int = Field(default=0, ge=0)
    """Processes that read pictures ahead; 0: they are read in between. The result is the same for any number."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Where networks are trained and evaluated: ``cpu``, ``cuda`` (a GPU), or ``auto``: a GPU where there is one."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """``bfloat16``: networks multiply in it in gradient steps alone (torch's autocast)."""
    clip_gradient: Positive | None = None
    """Largest norm of a gradient; null for no limit."""
    labels: LabelsSpec | None = None
    """Labels that say which option is active in some demonstrations; null for none."""
    duration: DurationSpec | None = None
    """A prior on how long options last; null for none."""

    @model_validator(mode="after")
    def _ends(self) -> TrainingSpec:
        if self.epochs is None and self.patience is None:
            raise invalid(("epochs", "null trains until training.patience, which is null too; give one of them"))
        if self.epochs is None and self.optimizer.schedule == "cosine":
            raise invalid(("optimizer.schedule", "cosine falls to 0 at the end of training.epochs, which is null"))
        if self.upper_levels == "segments" and not self.layerwise:
            raise invalid(("upper_levels", "segments are those of a lowest level found before; say layerwise: true"))
        if self.labels is not None and not self.labels.hold and self.initialize == "random":
            raise invalid(("labels.hold", "false uses labels in initialisation alone, which is random; say vq there"))
        return self
