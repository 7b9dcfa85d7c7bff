"""Progress events passed to ``on_event``, and their numbers in TensorBoard or Weights & Biases.

>>> import ddco_pyro
>>> from ddco_pyro.events import Log
>>> with Log("tensorboard", "runs/mine", {}) as log:
...     fit = ddco_pyro.fit("mine.yaml", out="runs/mine", on_event=log)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from ddco_pyro.errors import BadInput, nearest


class Event:
    """The base of all events."""


@dataclass(frozen=True)
class Counted(Event):
    """One more of ``total`` pieces of ``work`` is done, or ``done`` in all; ``total`` is None if unknown."""

    work: str
    total: int | None
    note: str = ""
    done: int | None = None


@dataclass(frozen=True)
class TrainingBegan(Event):
    """Training of a model begins, with a budget of epochs; None for no limit."""

    model: str
    epochs: int | None


@dataclass(frozen=True)
class EpochEnded(Event):
    """A row of the history: log-likelihood per step of training and tuning demonstrations, nats."""

    restart: int
    stage: str
    epoch: int
    train: float
    tune: float


@dataclass(frozen=True)
class RestartStopped(Event):
    """A restart far behind the likeliest was stopped after ``epochs`` epochs of its last stage."""

    restart: int
    epochs: int


@dataclass(frozen=True)
class RestartDiverged(Event):
    """A restart ended with a log-likelihood that is NaN or infinite; ``why`` has the place and the remedy."""

    restart: int
    why: str


@dataclass(frozen=True)
class TrainingEnded(Event):
    """Training of a model ended."""

    model: str


@dataclass(frozen=True)
class CellsBegan(Event):
    """A ``study`` or a ``cross-validation`` of ``total`` cells begins; ``kept`` of them are done already."""

    work: str
    total: int
    kept: int


@dataclass(frozen=True)
class CellDone(Event):
    """A cell is done, or failed for the reason ``failed``: of a cross-validation, a fold of a candidate."""

    cell: str
    failed: str


OnEvent = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Discard an event."""


# --- logs ---------------------------------------------------------------------------------------------------


Add = Callable[[Mapping[str, float], int], None]
"""Gives numbers of a step to a program."""


def tensorboard(folder: Path, spec: Mapping[str, Any]) -> tuple[Add, Callable[[], None]]:
    """An event file in ``tensorboard`` of the run folder: what adds numbers, and what closes it."""
    from torch.utils.tensorboard import SummaryWriter

    writer: Any = SummaryWriter(str(folder / "tensorboard"))
    writer.add_text("spec", f"```\n{spec}\n```")

    def add(values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, step)

    return add, writer.close


def wandb_offline(folder: Path, spec: Mapping[str, Any]) -> tuple[Add, Callable[[], None]]:
    """A run in ``wandb`` of the run folder, which ``wandb sync`` uploads; nothing is sent before."""
    import wandb

    named = {"project": "ddco-pyro", "name": folder.name, "dir": str(folder)}
    run: Any = wandb.init(**named, mode="offline", config=dict(spec))
    return lambda values, step: run.log({**values, "epoch": step}), run.finish


LOGS = {"tensorboard": (tensorboard, "tensorboard"), "wandb-offline": (wandb_offline, "wandb")}
"""The logs by name, each with the package that it needs, which is also its extra."""


class Log:
    """The log-likelihoods of each epoch in another program, in nats per step.

    ``<model>/<stage>/train`` and ``tune`` have a value for each epoch of a stage; restarts after the first
    are ``<model>/<stage>/restart <n>/train``. Where the program fails, the fit goes on without the log.

    :param name: one of :data:`LOGS`.
    :param folder: the run folder; nothing is written there before training begins.
    :param spec: its spec as plain data.
    :param say: gets a warning where the program fails.
    :raises BadInput: there is no such log, or its package is not installed.
    """

    def __init__(
        self, name: str, folder: str | Path, spec: Mapping[str, Any], say: Callable[[str], None] = print
    ) -> None:
        if name not in LOGS:
            there = ", ".join(LOGS)
            raise BadInput(f"--log: there is no log {name!r}{nearest(name, LOGS)}; there is: {there}")
        self._make, package = LOGS[name]
        if find_spec(package) is None:
            install = f"install it with: pip install 'ddco-pyro[{package}]'"
            raise BadInput(f"--log {name}: needs {package}; {install}")
        self._name, self._of, self._say = name, (Path(folder), spec), say
        self._program: tuple[Add, Callable[[], None]] | None = None
        self._model, self._failed = "", False

    def __call__(self, event: Event) -> None:
        """Log an event."""
        if isinstance(event, TrainingBegan):
            self._model = event.model
        if isinstance(event, EpochEnded):
            restart = f"/restart {event.restart}" if event.restart else ""
            place = f"{self._model}/{event.stage}{restart}"
            self.add({f"{place}/train": event.train, f"{place}/tune": event.tune}, event.epoch)

    def add(self, values: Mapping[str, float], step: int = 0) -> None:
        """Log the finite ones of these numbers."""
        finite = {name: value for name, value in values.items() if math.isfinite(value)}
        self._tried(lambda add, _: add(finite, step))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._program is not None:
            self._tried(lambda _, close: close())

    def _tried(self, call: Callable[[Add, Callable[[], None]], None]) -> None:
        """Call the program, which is made first; after an error it is left alone."""
        if self._failed:
            return
        try:
            self._program = self._program or self._make(*self._of)
            call(*self._program)
        except Exception as error:  # whatever the other program raises
            self._failed = True
            why = " ".join(str(error).split()) or type(error).__name__
            self._say(f"warning: --log {self._name}: {why}; the fit goes on without this log")
