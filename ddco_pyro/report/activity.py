"""Posteriors, most likely paths and terminations of demonstrations, as arrays for figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.sources.recording import label_names
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.names import option_name
from ddco_pyro.segmenting import Segmented, Segments, of_piece, of_run

MOST_BINS = 60


@dataclass(frozen=True)
class LevelActivity:
    """One level over N demonstrations of at most T steps, C = 1 + k choices, control first.

    :param names: the name of each choice, control first.
    :param active: u_t, the posterior probability of each choice [N, T, C]; 0 past a demonstration's end.
    :param path: choices of the most likely path [N, T]; -1 past the end.
    :param termination: ψ_h(s_t) of the k options [N, T, k].
    """

    name: str
    names: Sequence[str]
    active: np.ndarray
    path: np.ndarray
    termination: np.ndarray

    @property
    def choices(self) -> list[int]:
        """The choices that can occur: without control where it is never chosen."""
        return [choice for choice in range(self.active.shape[2]) if choice or self.active[..., 0].any()]


@dataclass(frozen=True)
class Activity:
    """All levels, lowest first, over the same demonstrations of ``lengths`` [N] steps.

    :param segmented: their segments, in the order and with the numbers of ``demonstrations_by_likelihood``.
    """

    levels: tuple[LevelActivity, ...]
    lengths: np.ndarray
    segmented: Segmented

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
    steps, pieces, segments = max(demos.lengths), [], dict[str, Segments]()
    labels = {demo.name: {name: demo.labels[name] for name in fit.spec.demonstrations.label_names} for demo in demos}
    for piece in fit.infer(demos):
        endings = (level[..., 1].exp() for level in piece.outputs.termination)
        arrays = zip(piece.posterior.u, piece.path.choices, endings, strict=True)
        pieces.append([(_padded(u.float(), steps), _padded(h, steps, -1), _padded(psi, steps)) for u, h, psi in arrays])
        segments |= {demo.name: demo for demo in of_piece(fit, piece, labels, intervals=True)}
    levels = tuple(
        LevelActivity(name, names, *map(np.concatenate, zip(*arrays, strict=True)))
        for (name, names), arrays in zip(fit.names.items(), zip(*pieces, strict=True), strict=True)
    )
    rows = {row.name: row for row in fit.metrics.demonstrations_by_likelihood}  # held out, where it trains too
    ordered = [
        replace(segments[name], log_likelihood=row.log_likelihood_per_step[fit.name], held_out=row.part == "valid")
        for name, row in rows.items()
        if name in segments
    ]
    segmented = of_run(fit, ordered, demos.frequency, label_names(demos.attributes))
    return Activity(levels, np.array(demos.lengths), segmented)


def _padded(values: Tensor, steps: int, end: float = 0.0) -> np.ndarray:
    """[N, T', ...] to [N, steps, ...]."""
    missing = [(0, 0), (0, steps - values.shape[1])] + [(0, 0)] * (values.ndim - 2)
    return np.pad(values.numpy(), missing, constant_values=end)


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
