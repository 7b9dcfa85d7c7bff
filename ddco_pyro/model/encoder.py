"""Observations by name to the features that networks see."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.data.arrays import PICTURE_DIMENSIONS, Observed, network_input
from ddco_pyro.data.controls import rounding
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.pictures import Transform, TransformError
from ddco_pyro.model.networks import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.inputs import Frames
from ddco_pyro.model.tables import by_step, by_trajectory
from ddco_pyro.spec import STEP, ObservationSpec

Shapes = Mapping[str, tuple[int, ...]]

NARROWEST = 1e-6
"""Least width of a bin that is a feature, as a part of the whole range; a narrower one is only centred."""


class ObservationEncoder(nn.Module):
    """Observations by name to one feature vector: angles and quaternions turned into numbers that do not
    jump, differences appended, standardised.

    Mean and standard deviation are those of the demonstrations given to :meth:`fit`, and are kept with the
    model. A dimension that varies by rounding alone (:func:`~ddco_pyro.data.controls.rounding`) is only
    centred, and so are differences whose dimension does so within each demonstration. What moves later moves
    in its own units, not in multiples of a rounding.

    ``bins`` add, for a number x, min(max(x, q_k), q_{k+1}) between each two neighbouring quantiles q of its
    distinct values, standardised as x is. This is a piecewise-linear encoding (Gorishniy, Rubachev and
    Babenko, On embeddings for numerical features in tabular deep learning, 2022).

    Pictures are cropped and scaled as the spec says when they are read, from a file or from memory.

    The built-in observation :data:`~ddco_pyro.spec.STEP` is made here: the number of the step divided by
    ``longest``, the steps of the longest demonstration given to :meth:`fit`.

    :param tasks: of the numbers of the built-in observation :data:`~ddco_pyro.spec.TASK`, in their order.
    :raises ShapeError: an observation cannot be read, cropped, scaled, binned or shifted as the spec says.
    """

    mean: Tensor
    std: Tensor
    longest: Tensor
    low: Tensor
    high: Tensor
    places: Tensor

    def __init__(self, specs: Sequence[ObservationSpec], shapes: Shapes, tasks: Sequence[str] = ()) -> None:
        super().__init__()
        self.tasks = tuple(tasks)
        shapes = {**shapes, STEP: (1,)}
        read = dict.fromkeys(
            key for spec in specs for key in (spec.key, spec.minus) if key not in (None, STEP)
        )
        self.shapes = {key: tuple(shapes[key]) for key in read}
        kinds = {}
        for spec in specs:
            kinds[spec.key], why = network_input(tuple(shapes[spec.key]))
            if why:
                raise ShapeError(f"observations: {spec.key!r} {why}")
            if spec.minus and (kinds[spec.key] == "picture" or shapes[spec.key] != shapes[spec.minus]):
                both = " and ".join(f"{key!r} has shape {[*shapes[key]]}" for key in (spec.key, spec.minus))
                raise ShapeError(f"observations: {both}; a difference is of vectors of as many numbers")
        self.specs = tuple(spec for spec in specs if kinds[spec.key] == "vector")
        pictures = [spec for spec in specs if kinds[spec.key] == "picture"]
        self.transforms = {spec.key: Transform(spec.crop, spec.resize) for spec in pictures}
        self.shifts = {spec.key: spec.shift for spec in pictures if spec.shift}
        seen = {spec.key: _seen_shape(spec, shapes) for spec in specs}
        self.images = {spec.key: seen[spec.key] for spec in pictures}
        widths = [spec.turned(int(np.prod(shapes[spec.key]))) for spec in self.specs]
        self.given = [width * spec.given for width, spec in zip(widths, self.specs, strict=True)]
        self.sizes = [width * spec.seen for width, spec in zip(widths, self.specs, strict=True)]
        self.register_buffer("mean", torch.zeros(sum(self.sizes), dtype=torch.float64))
        self.register_buffer("std", torch.ones(sum(self.sizes), dtype=torch.float64))
        if self.has_bins:
            self.register_buffer("places", torch.as_tensor(self._places()), persistent=False)
            self.register_buffer("low", torch.full_like(self.mean, -torch.inf))
            self.register_buffer("high", torch.full_like(self.mean, torch.inf))
        if STEP in self.keys:
            self.register_buffer("longest", torch.ones((), dtype=torch.float64))

    @property
    def keys(self) -> list[str]:
        """What networks call each vector observation."""
        return [spec.name for spec in self.specs]

    def shape(self, steps: int) -> InputShape:
        """The shapes that networks are built for."""
        return InputShape(dict(zip(self.keys, self.sizes, strict=True)), self.images, steps)

    def fit(self, demonstrations: Demonstrations) -> None:
        """Take mean, standard deviation, bins and the longest demonstration from these demonstrations."""
        if STEP in self.keys:
            self.longest.fill_(max(demonstrations.lengths))
        each = [self.features(demo.observations) for demo in demonstrations]
        moves, rows = self._moves(each, demonstrations), np.concatenate(each)
        if self.has_bins:
            self._fit_bins(rows)
            places, cut = self.places.numpy(), self._cut(torch.as_tensor(rows)).numpy()
            moves = moves[places] & (np.ptp(cut, axis=0) > NARROWEST * np.ptp(rows, axis=0)[places])
            rows = cut
        self.mean.copy_(torch.as_tensor(rows.mean(0)))
        self.std.copy_(torch.as_tensor(np.where(moves, rows.std(0), 1.0)))

    @property
    def has_bins(self) -> bool:
        return any(spec.bins for spec in self.specs)

    def _places(self) -> np.ndarray:
        """The feature of :meth:`features` behind each number that networks see, [F'].

        A key's own come first, then those of its bins.
        """
        firsts = np.cumsum([0, *self.given])
        rows = zip(self.specs, firsts, self.given, strict=False)
        return np.concatenate(
            [np.tile(np.arange(first, first + count), 1 + spec.bins) for spec, first, count in rows]
        )

    def _fit_bins(self, rows: np.ndarray) -> None:
        """Take the ends of each bin from ``rows`` [T, F]: quantiles of the distinct values.

        A value that most steps have counts once, so that the other values do not share a single bin.
        """
        at = 0
        for spec, count, size in zip(self.specs, self.given, self.sizes, strict=True):
            own = rows[:, self.places[at : at + count].numpy()]
            parts = np.linspace(0, 1, spec.bins + 1)
            each = [np.quantile(np.unique(values), parts, method="nearest") for values in own.T]
            ends = torch.as_tensor(np.column_stack(each))
            self.low[at + count : at + size] = ends[:-1].flatten()
            self.high[at + count : at + size] = ends[1:].flatten()
            at += size

    def _cut(self, features: Tensor) -> Tensor:
        """Features [..., F], and again clipped to each bin, [..., F']."""
        if not self.has_bins:
            return features
        return torch.minimum(torch.maximum(features[..., self.places], self.low), self.high)

    def scaled(self, features: np.ndarray) -> np.ndarray:
        """Features [T, F] as networks see them [T, F'], in double precision."""
        return ((self._cut(torch.as_tensor(features)) - self.mean) / self.std).numpy()

    def _moves(self, rows: Sequence[np.ndarray], demonstrations: Demonstrations) -> np.ndarray:
        """Which features [F] of these demonstrations' ``rows`` [T_n, F] vary by more than rounding.

        Differences do where their dimension does within a demonstration.
        """
        low, high = (np.stack([end(part, axis=0) for part in rows]) for end in (np.min, np.max))
        moves, first = [np.zeros(0, dtype=bool)], 0
        for spec, size in zip(self.specs, self.given, strict=True):
            keys = [key for key in (spec.key, spec.minus) if key not in (None, STEP)]
            arrays = [demo.observations[key] for key in keys for demo in demonstrations]
            dtype = np.result_type(*arrays) if arrays else np.dtype(np.float64)
            own = slice(first, first + size // spec.given)
            lowest, highest = low[:, own].min(0), high[:, own].max(0)
            most = rounding(lowest, highest, dtype)
            moves.append(highest - lowest > most)
            if spec.differences:
                moves.append((high - low)[:, own].max(0) > most)
            first += size
        return np.concatenate(moves)

    def features(self, observations: Mapping[str, Observed], times: np.ndarray | None = None) -> np.ndarray:
        """Observations [T, ...] by name to features [T, F], not yet standardised.

        :param times: the number of each step [T]; by default 0 to T - 1.
        """
        steps = len(next(iter(observations.values())))
        times = np.arange(steps) if times is None else times
        columns: list[np.ndarray] = [np.zeros((steps, 0))]
        for spec in self.specs:
            seen = times / float(self.longest) if spec.key == STEP else observations[spec.key]
            values = np.asarray(seen, dtype=np.float64).reshape(steps, -1)
            if spec.minus:
                values = values - np.asarray(observations[spec.minus], dtype=np.float64).reshape(steps, -1)
            column = _turned(values, spec)
            columns.append(column)
            if spec.differences:
                columns.append(np.diff(column, axis=0, prepend=column[:1]))
        return np.concatenate(columns, axis=1)

    def standardized(self, features: Tensor) -> dict[str, Tensor]:
        """Features [..., F] as networks see them, [..., F_key] by name."""
        vector = ((self._cut(features) - self.mean) / self.std).float()
        # A split into nothing cannot be read again from an exported program.
        return dict(zip(self.keys, vector.split(self.sizes, -1), strict=True)) if self.sizes else {}

    def inputs(
        self, observations: Iterable[Mapping[str, Observed]], times: np.ndarray | None = None
    ) -> Inputs:
        """Sequences of observations, each [T_n, ...] by name, to padded network inputs.

        Pictures are read when a network asks for them.

        :param times: as in :meth:`features`.
        """
        sequences = list(observations)
        vectors = [self.scaled(self.features(sequence, times)) for sequence in sequences]
        vector = padded(vectors).float()
        by_key, steps = dict(zip(self.keys, vector.split(self.sizes, -1), strict=True)), vector.shape[1]
        images = {
            key: Frames(tuple(sequence[key] for sequence in sequences), self.transforms[key], slice(0, steps))
            for key in self.images
        }
        return Inputs(by_key, images, torch.arange(steps))


def _turned(values: np.ndarray, spec: ObservationSpec) -> np.ndarray:
    """Numbers [T, n] with sines and cosines of angles, and products of quaternions, behind all others."""
    angles, first = list(spec.angles), np.array(spec.quaternions, dtype=int)
    if not angles and not len(first):
        return values
    quaternions = values[:, first[:, None] + np.arange(4)]  # [T, quaternions, 4]
    one, other = np.triu_indices(4)
    products = (quaternions[..., one] * quaternions[..., other]).reshape(len(values), -1)
    rest = np.delete(values, [*angles, *(first[:, None] + np.arange(4)).ravel()], axis=1)
    return np.concatenate([rest, np.sin(values[:, angles]), np.cos(values[:, angles]), products], axis=1)


def _seen_shape(spec: ObservationSpec, shapes: Shapes) -> tuple[int, ...]:
    """The shape of a step of an observation as networks see it."""
    stored = shapes[spec.key]
    if spec.bins and len(stored) == PICTURE_DIMENSIONS:
        raise ShapeError(f"observations: {spec.key!r} has pictures: bins are for vectors")
    size = int(np.prod(stored))
    last = max([*spec.angles, *(first + 3 for first in spec.quaternions)], default=-1)
    if last >= 0 and (len(stored) == PICTURE_DIMENSIONS or last >= size):
        raise ShapeError(
            f"observations: {spec.key!r} has shape {list(stored)} at each step: angles and quaternions name "
            f"numbers of a vector, counted from 0, and there is no number {last}"
        )
    if spec.shift and len(stored) != PICTURE_DIMENSIONS:
        raise ShapeError(
            f"observations: {spec.key!r} has shape {list(stored)} at each step: shift is for pictures"
        )
    try:
        return Transform(spec.crop, spec.resize).shape(stored)
    except TransformError as error:
        raise ShapeError(f"observations: {spec.key!r} {error}") from error


def padded(sequences: Sequence[np.ndarray]) -> Tensor:
    """Arrays [T_n, ...] as one tensor [N, max T_n, ...], zeros past their ends; in memory [..., T, N]."""
    each = [torch.as_tensor(sequence) for sequence in sequences]
    return by_trajectory(by_step(nn.utils.rnn.pad_sequence(each, batch_first=True)).contiguous())
