"""What restarts are trained on, and the training state of one restart, in memory and as a checkpoint file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec
from ddco_pyro.training.labels import Labels
from ddco_pyro.training.networks import Dimensions, build_hierarchy
from ddco_pyro.training.prior import Prior
from ddco_pyro.training.processes import device_of
from ddco_pyro.training.stages import starts_of

State = dict[str, Tensor]


@dataclass(frozen=True)
class TrainingData:
    """What all restarts of a model share: demonstrations to train and to tune on, encoded and scaled.

    :param names: of the training demonstrations.
    :param fitted: the state of the fitted encoder and scaling, and of a recogniser that labels train, by the
        names that they have in a hierarchy (:func:`fitted_of`).
    :param labels: the labels that say which options are active; None where there are none.
    :param library: the prior that a library is (``training.library``).
    """

    spec: Spec
    dimensions: Dimensions
    train: Batch
    tune: Batch
    names: Sequence[str]
    fitted: State
    labels: Labels | None = None
    library: Prior | None = None

    def hierarchy(self, restart: int, state: State | None = None) -> Hierarchy:
        """A restart's hierarchy in evaluation mode, with its networks on the spec's device.

        :param state: of the hierarchy; None for the restart's first weights, which may be those of a library.
        """
        hierarchy = build_hierarchy(self.spec, self.dimensions, self.seed(restart))
        hierarchy.load_state_dict(self.fitted, strict=False)
        if state is None and self.library is not None and self.library.ridge:
            hierarchy.load_state_dict(dict(self.library.model.named_parameters()), strict=False)
        if state is not None:
            hierarchy.load_state_dict(state)
        return hierarchy.place(device_of(self.spec.training)).eval()

    def seed(self, restart: int, *place: int) -> int:
        """The seed of a restart, of one of its stages, of an epoch of a stage, or of a shard of a minibatch.

        The first restarts of two ways to begin have the same seeds, and so have the second ones: the way
        alone differs. numpy pads with zeros: a stage has the seed of its first epoch, and the first stage
        that of its restart. They draw different things.
        """
        own, training = self.spec.seed, self.spec.training.seed
        entropy = [own if training is None else training, self.repetition(restart), *place]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])

    def repetition(self, restart: int) -> int:
        """How many restarts before this one begin in the same way."""
        starts = starts_of(self.spec)
        return starts[:restart].count(starts[restart])


@dataclass
class Progress:
    """How far a restart has been trained, at the end of an epoch.

    Where all stages have ended (``done``), ``epoch``, ``start`` and ``best`` are those of the last stage.

    :param restart: its number.
    :param stage: the number of the current stage.
    :param epoch: epochs of the current stage.
    :param stale: epochs since the best one.
    :param start: tuning log-likelihood per step before the current stage.
    :param best: the best tuning log-likelihood per step of the current stage.
    :param objective: of training demonstrations under the kept model, with its log-prior, nats per step.
    :param sounded: the same at the pause in which restarts are compared, or at the end if that came first.
    :param ended: a :class:`ddco_pyro.metrics.Stage` for each stage that has ended.
    :param history: a row for each epoch.
    :param device: the kind of device that its networks are trained on.
    :param diverged: where a log-likelihood became NaN or infinite, which ended the restart.
    """

    restart: int
    stage: int = 0
    epoch: int = 0
    stale: int = 0
    start: float = -np.inf
    best: float = -np.inf
    objective: float = -np.inf
    sounded: float = -np.inf
    done: bool = False
    ended: list[dict[str, Any]] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)
    device: str = "cpu"
    diverged: str | None = None

    @property
    def tune(self) -> Sequence[float]:
        """Tuning log-likelihood per step before the current stage, and of each of its epochs."""
        return [self.start, *(row["tune"] for row in self.history[len(self.history) - self.epoch :])]

    @property
    def spent(self) -> int:
        """Epochs of the stages that have ended."""
        return sum(end["epochs"] for end in self.ended)

    def reached(self, last: int, until: int | None) -> bool:
        """Whether training is over, or has come to epoch ``until`` of the stage ``last``."""
        return self.done or (until is not None and self.stage == last and self.epoch >= until)


@dataclass
class Restart:
    """A restart in training: its progress and its tensors.

    :param states: tensors of the ``model``, of its ``optimizer`` and of the ``best`` epoch of the current
        stage; where there are any, of the ``average`` of weights, and the ``known`` choices and the
        ``constants`` of the objective. A restart that is done has the best alone, one that has diverged
        nothing.
    :param paused: the stage in which it pauses, in memory alone.
    """

    progress: Progress
    states: dict[str, State] = field(default_factory=dict)
    paused: Any = field(default=None, repr=False)

    def written(self, path: Path | None) -> Restart:
        """This restart, written as a checkpoint where there is a path: whole or not at all."""
        if path is not None:
            named = ((part, *item) for part, state in self.states.items() for item in state.items())
            tensors = {f"{part}/{name}": value for part, name, value in named}
            write_tensors(path, tensors, {"progress": json.dumps(asdict(self.progress))})
        return self

    @classmethod
    def read(cls, path: Path) -> Restart:
        """Read a checkpoint.

        :raises Damaged: the file does not hold what was written.
        """
        tensors, metadata = read_tensors(path, "remove it and do the same again: this restart begins anew")
        states: dict[str, State] = {"optimizer": {}}
        for name, value in tensors.items():
            part, _, rest = name.partition("/")
            states.setdefault(part, {})[rest] = value
        return cls(Progress(**json.loads(metadata["progress"])), states)


def fitted_of(model: Hierarchy) -> State:
    """What of a hierarchy is fitted before it is trained: its encoder and its scaling."""
    fitted = ("encoder.", "scaling.")
    return {name: value for name, value in model.state_dict().items() if name.startswith(fitted)}


def copy_of(model: nn.Module) -> State:
    """A copy of a model's tensors, on the host."""
    return {name: value.detach().cpu().clone() for name, value in model.state_dict().items()}
