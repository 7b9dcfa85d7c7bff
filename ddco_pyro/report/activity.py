"""Posteriors, most likely paths and terminations of demonstrations, as arrays for figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources.recording import label_names
from ddco_pyro.evaluation.inferred import Inferred
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import option_name
from ddco_pyro.segmenting import Segmented, Segments, of_piece, of_run
from ddco_pyro.segmenting.page import label_colours

MOST_BINS = 60


@dataclass(frozen=True)
class LevelActivity:
    """One level over N demonstrations of at most T steps, C = 1 + k choices, control first.

    :param active: u_t, the posterior probability of each choice [N, T, C]; 0 past a demonstration's end.
    :param path: choices of the most likely path [N, T]; -1 past the end.
    :param ended: whether the path makes a new choice at this step: 1, 0, or -1 past the end [N, T].
    :param termination: ψ_h(s_t) of the k options [N, T, k].
    :param lasts: whether options can be active for more than one step.
    :param names: the name of each choice, control first.
    """

    name: str
    active: np.ndarray
    path: np.ndarray
    ended: np.ndarray
    termination: np.ndarray
    lasts: bool = field(default=True, kw_only=True)
    names: Sequence[str] = field(default=(), kw_only=True)

    @property
    def choices(self) -> list[int]:
        """The choices that can occur: without control where it is never chosen."""
        return [choice for choice in range(self.active.shape[2]) if choice or self.active[..., 0].any()]


NOTHING = Segmented((), {}, None)


@dataclass(frozen=True)
class Activity:
    """All levels, lowest first, over the same demonstrations of ``lengths`` [N] steps, and their segments."""

    levels: tuple[LevelActivity, ...]
    lengths: np.ndarray
    segmented: Segmented = NOTHING

    @cached_property
    def label_colours(self) -> dict[str, dict[int, str]]:
        """The colour of each label by the name of the labels: that of the option that it is matched with."""
        return label_colours(self.segmented)

    @property
    def choices(self) -> set[int]:
        """The choices that can occur at any level."""
        return {choice for level in self.levels for choice in level.choices}

    @property
    def names(self) -> list[str]:
        """The name of each choice, control first: those of all levels, the highest level first."""
        each: dict[int, list[str]] = {}
        for level in reversed(self.levels):
            for choice in range(level.active.shape[2]):
                each.setdefault(choice, []).append(option_name(choice, level.names))
        return [" / ".join(dict.fromkeys(each[choice])) for choice in sorted(each)]


def activity(fit: Fit, demos: Demonstrations) -> Activity:
    """The activity of a fit with at least one level."""
    assert fit.spec.hierarchy is not None  # a baseline has no levels
    known = fit.spec.hierarchy.levels
    labels = {demo.name: {name: demo.labels[name] for name in fit.spec.demonstrations.label_names} for demo in demos}
    parts: list[tuple[list[np.ndarray], ...]] = []
    segments: list[Segments] = []
    for piece in fit.infer(demos):
        parts.append(_arrays(piece, max(demos.lengths)))
        segments += of_piece(fit, piece, labels, intervals=True)
    levels = []
    for number, level in enumerate(known):
        arrays = (np.concatenate([part[what][number] for part in parts]) for what in range(4))
        levels.append(LevelActivity(level.name, *arrays, lasts=level.lasts, names=fit.names[level.name]))
    segmented = of_run(fit, segments, demos.frequency, label_names(demos.attributes))
    return Activity(tuple(levels), np.array(demos.lengths), segmented)


def _arrays(piece: Inferred, steps: int) -> tuple[list[np.ndarray], ...]:
    active = [_padded(u.float().numpy(), steps, 0.0) for u in piece.posterior.u]
    choices, ended = ([_padded(level.numpy(), steps, -1) for level in part] for part in piece.path)
    termination = [_padded(level[..., 1].exp().numpy(), steps, 0.0) for level in piece.outputs.termination]
    return active, choices, ended, termination


def _padded(array: np.ndarray, steps: int, value: float) -> np.ndarray:
    """[N, T', ...] to [N, steps, ...]."""
    missing = [(0, 0), (0, steps - array.shape[1])] + [(0, 0)] * (array.ndim - 2)
    return np.pad(array, missing, constant_values=value)


@dataclass(frozen=True)
class Bins:
    """Steps of demonstrations gathered into bins of time.

    :param index: the bin of each step [N, T]; -1 past a demonstration's end.
    :param edges: the bins' edges [B + 1], in steps or as shares of a demonstration.
    :param axis: the label of the time axis.
    """

    index: np.ndarray
    edges: np.ndarray
    axis: str

    def mean(self, values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Weighted mean over the steps [N, T] of each bin [B]; NaN where the weights sum to 0."""
        total, weight = self.total(values * weights), self.total(weights)
        return np.divide(total, weight, out=np.full(len(total), np.nan), where=weight > 0)

    def total(self, values: np.ndarray) -> np.ndarray:
        """Sum over the steps [N, T] of each bin [B]."""
        inside = self.index >= 0
        return np.bincount(self.index[inside], values[inside], minlength=len(self.edges) - 1)


def bins(lengths: np.ndarray) -> Bins:
    """One bin for each step of equally long, short demonstrations; else bins of normalised time."""
    steps = np.arange(lengths.max())
    alive = steps < lengths[:, None]
    if len(set(lengths)) == 1 and lengths[0] <= MOST_BINS:
        index = np.broadcast_to(steps, alive.shape)
        return Bins(index, np.arange(lengths[0] + 1) - 0.5, "step t")
    count = int(min(MOST_BINS, lengths.min()))
    index = np.minimum((steps + 0.5) / lengths[:, None] * count, count - 1).astype(int)
    return Bins(
        np.where(alive, index, -1), np.linspace(0.0, 1.0, count + 1), "share of the demonstration that has passed"
    )
