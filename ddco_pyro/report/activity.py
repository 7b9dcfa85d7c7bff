"""Posteriors and most likely paths of demonstrations, as arrays for figures."""

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


@dataclass(frozen=True)
class LevelActivity:
    """One level over N demonstrations of at most T steps, C = 1 + k choices, control first.

    :param names: the name of each choice, control first.
    :param active: u_t, the posterior probability of each choice [N, T, C]; 0 past a demonstration's end.
    :param path: choices of the most likely path [N, T]; -1 past the end.
    """

    name: str
    names: Sequence[str]
    active: np.ndarray
    path: np.ndarray

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
        arrays = zip(piece.posterior.u, piece.path.choices, strict=True)
        pieces.append([(_padded(u.float(), steps), _padded(h, steps, -1)) for u, h in arrays])
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
