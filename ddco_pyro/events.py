"""What long work tells whoever watches it: one event at a time, to one callback."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class DemonstrationsDone:
    """So many of the demonstrations have been collected, imported, segmented or encoded."""

    done: int
    total: int


@dataclass(frozen=True)
class TrainingBegan:
    """A model begins to be trained, for at most so many epochs in all; None for no limit."""

    model: str
    epochs: int | None


@dataclass(frozen=True)
class EpochEnded:
    """A row of the history: log-likelihood per step, nats, of the training and the tuning demonstrations."""

    restart: int
    stage: str
    epoch: int
    train: float
    tune: float


@dataclass(frozen=True)
class UpdatesDone:
    """So many gradient steps are done; mean loss of the last ones."""

    done: int
    loss: float


@dataclass(frozen=True)
class RestartStopped:
    """A restart has been stopped after so many epochs of its last stage: others are better."""

    restart: int
    epochs: int


@dataclass(frozen=True)
class RestartDiverged:
    """A restart has ended because a log-likelihood became NaN or infinite: ``why`` names the place and the remedy."""

    restart: int
    why: str


@dataclass(frozen=True)
class TrainingEnded:
    """A model has been trained."""

    model: str


@dataclass(frozen=True)
class SelectionBegan:
    """So many (candidate, fold) are to be scored in all, of which some were kept from before."""

    total: int
    kept: int


@dataclass(frozen=True)
class FoldScored:
    """A fold of a candidate has been scored, or has failed: why, else empty."""

    candidate: str
    fold: int
    failed: str


@dataclass(frozen=True)
class CandidateGivenUp:
    """A candidate has been stopped early: so many of its folds need not be scored."""

    candidate: str
    folds: int


@dataclass(frozen=True)
class SeedFitted:
    """The model and its baselines have been fitted with one more of ``total`` other training seeds."""

    total: int


@dataclass(frozen=True)
class EpisodeEnded:
    """One of ``total`` episodes, of the method so named, has ended."""

    method: str
    total: int


Event = (
    DemonstrationsDone
    | TrainingBegan
    | EpochEnded
    | UpdatesDone
    | RestartStopped
    | RestartDiverged
    | TrainingEnded
    | SelectionBegan
    | FoldScored
    | CandidateGivenUp
    | SeedFitted
    | EpisodeEnded
)
OnEvent = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Nobody watches."""
