"""Where the training of a restart stands, in memory and as a file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.data.tensors import read_tensors, write_tensors

State = dict[str, Tensor]


@dataclass
class Progress:
    """Where a restart stands at the end of an epoch; with the tensors of a checkpoint it is all that is needed.

    ``start`` is the tuning log-likelihood per step from before this stage, ``best`` that of its best epoch, ``ended``
    has a :class:`ddco_pyro.training.convergence.StageEnd` for each stage that has ended, ``history`` a row for each
    epoch. Where all stages have ended (``done``), ``epoch``, ``start`` and ``best`` are still those of the last.
    ``device`` is the kind of device that its networks were trained on. ``diverged`` says where a log-likelihood became
    NaN or infinite in a further epoch, which ended the restart.
    """

    restart: int
    stage: int = 0
    epoch: int = 0
    stale: int = 0
    start: float = -np.inf
    best: float = -np.inf
    done: bool = False
    ended: list[dict[str, Any]] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)
    device: str = "cpu"
    diverged: str | None = None

    @property
    def tune(self) -> Sequence[float]:
        """Tuning log-likelihood per step from before this stage, and of each of its epochs."""
        return [self.start, *(row["tune"] for row in self.history[len(self.history) - self.epoch :])]


@dataclass
class Restart:
    """A restart that is being trained: its progress, and the tensors of its ``model``, its ``optimizer``, of the
    ``best`` epoch of this stage, and the ``average`` of weights and the ``constants`` that it takes over, if any. One
    that is done has the best alone, one that has diverged nothing.
    """

    progress: Progress
    states: dict[str, State] = field(default_factory=dict)

    def write(self, path: Path) -> None:
        """Write a checkpoint, whole or not at all."""
        tensors = {f"{part}/{name}": value for part, state in self.states.items() for name, value in state.items()}
        write_tensors(path, tensors, {"progress": json.dumps(asdict(self.progress))})

    @classmethod
    def read(cls, path: Path) -> Restart:
        """Read a checkpoint.

        :raises Damaged: it does not hold what was written.
        """
        tensors, metadata = read_tensors(path, "remove it and do the same again: this restart begins anew")
        states: dict[str, State] = {"optimizer": {}}
        for name, value in tensors.items():
            part, _, rest = name.partition("/")
            states.setdefault(part, {})[rest] = value
        return cls(Progress(**json.loads(metadata["progress"])), states)


def copy_of(model: nn.Module) -> State:
    """The tensors of a model as they are now, on the host."""
    return {name: value.detach().cpu().clone() for name, value in model.state_dict().items()}


def optimizer_state(optimizer: torch.optim.Optimizer) -> State:
    """The optimiser's tensors by ``<parameter>.<name>``, as they are now, on the host."""
    state = optimizer.state_dict()["state"]
    return {
        f"{index}.{name}": torch.as_tensor(value).cpu().clone()
        for index, values in state.items()
        for name, value in values.items()
        if value is not None
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, state: State) -> None:
    """Give an optimiser the tensors of :func:`optimizer_state`."""
    nested: dict[int, State] = {}
    for key, value in state.items():
        index, _, name = key.partition(".")
        nested.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": nested})
