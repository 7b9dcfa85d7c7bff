"""Settings of training: optimiser, stages, early stopping and labels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from ddco_pyro.spec.base import Count, Fraction, Items, Model, Positive, Problems, Seed, Share, Text, nested


class RidgeSpec(Model):
    """Ridges of EM: precisions of a normal prior on the weights of linear maps, biases left out."""

    policy: float = Field(default=1.0, ge=0)
    """Of the means of controls: as many steps, of observations with unit variance, that say 0; in units of
    1/σ². Also of the logits of switches and discrete actions."""
    gate: float = Field(default=1.0, ge=0)
    """Of the logits of options and of terminations."""
    cross_validated: bool = False
    """Whether ``policy`` is raised, to at most 1000 times as much, where leaving out training demonstrations
    shows that a larger one explains them better by half a nat per step."""


class OptimizerSpec(Model):
    """The optimiser of the expectation-gradient steps."""

    name: Literal["adam", "adamw", "momentum", "em"] = "adam"
    """``adam``, ``adamw``, ``momentum`` for gradient descent with momentum 0.9, or ``em``:
    expectation-maximisation where every network of a model is linear, L-BFGS for perceptrons without dropout
    in a policy without options, ``adam`` for other models. A spec whose networks are all linear, and that
    gives no other setting of gradient steps, has ``em`` if it names none."""
    ridge: RidgeSpec = RidgeSpec()
    """Ridges (``em`` only)."""
    lr: Positive = 1e-3
    """Learning rate."""
    schedule: Literal["constant", "cosine"] = "constant"
    """``cosine``: in each stage the learning rate falls along half a cosine to 0 at the last epoch of the
    stage's budget; needs ``training.epochs``."""
    weight_decay: float = Field(default=0.0, ge=0)
    """L2 penalty; for ``adamw`` the decoupled weight decay: every weight shrinks by ``lr`` × this in a step.
    Models that ``em`` trains have ridges instead."""


class RecogniserSpec(Model):
    """A recogniser of the options of labelled steps; its evidence places the options of unlabelled steps."""

    weight: float = Field(default=0.3, ge=0)
    """γ: how many times log r(h | window) − log p(h) counts beside the log-density (``control.power``)."""
    ridge: Positive = 50.0
    """Precision of a normal prior on the weights of standardised features."""


_RECOGNISER = "a mapping with weight and ridge, or cross_validated"
RecogniserOf = Annotated[
    RecogniserSpec | Literal["cross_validated"] | None,
    nested((Mapping,), RecogniserSpec, _RECOGNISER, ("cross_validated",)),
]


class LabelsSpec(Model):
    """Labels that fix the active option of one level; steps labelled −1 are free. None held out is used."""

    model_config = ConfigDict(serialize_by_alias=True)

    level: Text
    """Name of the level."""
    source: Text = Field(alias="from")
    """Name of the integer labels in the file; the sorted labels from 0 on are the options 1, 2, ..."""
    recogniser: RecogniserOf = None
    """A recogniser that the labelled steps train, for steps without labels and for other demonstrations;
    null: none. ``cross_validated``: ``weight``, ``ridge`` and ``control.power`` are chosen by leaving out
    labelled demonstrations in turn, or parts of a single one: the best mean of accuracy and edit score."""


class LibrarySpec(Model):
    """A library: a run whose model is the prior of this one. Encoder, scaling and kinds of controls are the
    run's.
    """

    run: Text
    """The run folder. Its model, or one of its baselines, has the same observations, control and networks."""
    ridge: Annotated[float, Field(ge=0)] | None = None
    """As many steps that say what the library's weights say: the precision of a normal prior centred there,
    in units of 1/σ² for means of controls whose σ does not depend on the state. Training begins there. Null:
    the strength that the library's own tasks chose. 0: weights begin by ``starts``, with the ridges of
    ``optimizer``."""
    spread: Positive = 20.0
    """As many controls that have the library's σ, of each option and dimension."""


Layerwise = Annotated[
    bool | Literal["segments"], nested((), lambda value: value, "true, false, or segments", ("segments",))
]
Start = Literal["vq", "vq_controls", "windows", "equal_parts", "mixture", "random"]


class TrainingSpec(Model):
    """How the model is trained."""

    starts: Annotated[Items[Start], Field(min_length=1)] = ("vq",)
    """Ways to begin. Training goes on from each, and keeps the model with the highest objective on the
    training demonstrations: the log-likelihood (``control.power``) with the log-prior of the ridges.

    ``vq``: vector quantisation of the observations that the options' policies read (SM 2.2). ``vq_controls``:
    of these observations and the controls. ``windows``: of means of both over ``window`` steps.
    ``equal_parts``: each demonstration cut into k parts of equal length, for skills that follow one another.
    ``mixture``: first the memoryless mixture (ψ = 1) is trained from ``vq_controls``; then ψ starts at 1/2,
    and all levels train together, whatever ``layerwise`` says. ``random``: random weights. Named again, a way
    begins from other random numbers: the first clusters are the best of ten runs of k-means, further ones a
    run from random steps each."""
    margin: float = Field(default=0.0, ge=0)
    """Nats per step by which the objective of a later start has to exceed that of the first to be kept."""
    window: Count = 10
    """Steps before and after a step over which ``windows`` averages observations and controls. People's
    skills show over a second, not in a step."""
    layerwise: Layerwise = True
    """Whether levels are discovered one after another, lowest first, rather than all at once; in the end all
    levels train together. ``segments``: the lowest alone, then all above it together, from the order of its
    options."""
    optimizer: OptimizerSpec = OptimizerSpec()
    """The optimiser."""
    epochs: Count | None = 800
    """Budget of passes over the training demonstrations, all stages together; every model has the same
    budget. A stage may take an even share of the remaining budget. Null: no limit except ``patience``."""
    average: Fraction | None = None
    """Decay per gradient step of an exponential moving average of the weights, which is evaluated and kept in
    place of the last weights; null: the last weights."""
    batch_size: Count = 16
    """Trajectories in each gradient step."""
    shards: Count = 1
    """Number of parts of a minibatch, and the most processes of ``torchrun`` that can share it. Results
    depend on the number of shards, by rounding and dropout, and not on the number of processes."""
    seed: Seed | None = None
    """Seed of initial weights, clusters, the order of demonstrations, and dropout; null: the spec's ``seed``.
    The split into training, tuning and held-out demonstrations does not depend on this seed."""
    tune_fraction: Share = 0.1
    """Fraction of the training demonstrations used for tuning, which stops training early; at least one
    demonstration. With 0, ``em`` trains on all of them until it converges."""
    tune_by: Literal["mean", "median"] = "mean"
    """The tuning score: ``mean`` of the objective over steps, or ``median`` over demonstrations, which is
    robust to a single outlier."""
    patience: Count | None = 20
    """Epochs without improvement after which a stage stops; null: never."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """Device of the networks: ``cpu``, ``cuda`` (a GPU), or ``auto`` (a GPU if there is one)."""
    labels: LabelsSpec | None = None
    """Labels that fix active options in some demonstrations; null: none."""
    library: LibrarySpec | None = None
    """A run of other tasks: training begins at its model, which is the prior of this one, whatever ``starts``
    says. Null: none."""

    @property
    def begins_at_library(self) -> bool:
        """Whether the weights begin at those of a library, which are the centre of their prior."""
        return self.library is not None and self.library.ridge != 0

    @property
    def takes_gradient_steps(self) -> bool:
        """Whether the spec names an optimiser, or gives a setting that gradient steps alone have."""
        given = self.optimizer.model_fields_set - {"ridge"} or {"average"} & self.model_fields_set
        return bool(given) and self.optimizer.name != "em"

    def problems(self) -> Problems:
        if self.optimizer.name == "em":
            unused = {"average": self.average, "optimizer.schedule": self.optimizer.schedule != "constant"}
            for key, value in unused.items():
                if value:
                    yield key, "em takes no gradient steps and would not use it; leave it out"
        if self.epochs is None and self.patience is None:
            yield "epochs", "epochs and training.patience are both null; give one of them"
        if self.epochs is None and self.optimizer.schedule == "cosine":
            yield "optimizer.schedule", "cosine ends at training.epochs, which is null"
