"""Progress events passed to ``on_event``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


class Event:
    """The base of all events."""


@dataclass(frozen=True)
class DemonstrationsDone(Event):
    """``done`` of ``total`` demonstrations are collected, imported, segmented or encoded."""

    done: int
    total: int


@dataclass(frozen=True)
class BaselineSegmented(Event):
    """One of ``total`` baselines has segmented the demonstrations."""

    baseline: str
    total: int


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
class OptionsCompared(Event):
    """``done`` of ``total`` options are compared with the others of their level."""

    done: int
    total: int


@dataclass(frozen=True)
class LengthTried(Event):
    """A power of the control's log-density, and gates that are constant or not, gave this median segment, steps."""

    power: float
    constant: bool
    median: float


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


@dataclass(frozen=True)
class SeedFitted(Event):
    """The model and its baselines are fitted with another of ``total`` training seeds."""

    total: int


@dataclass(frozen=True)
class EpisodeEnded(Event):
    """One of ``total`` episodes of a method ended."""

    method: str
    total: int


OnEvent = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Discard an event."""
