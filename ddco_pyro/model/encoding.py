"""Demonstrations as the networks see them: features, scaled controls, padded batches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.data.checks import rounding
from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.data.pictures import PICTURE_DIMENSIONS, Observed, Pictures, Readers, Transform, TransformError
from ddco_pyro.model.controls import ControlScaling, refuse_impossible
from ddco_pyro.model.frames import Frames
from ddco_pyro.model.networks import Inputs, InputShape, ShapeError
from ddco_pyro.spec import STEP, AugmentSpec, ObservationSpec

Shapes = Mapping[str, tuple[int, ...]]
STEPS_AT_ONCE = 8192
"""Longer batches are processed in parts, in smaller ones where a step takes much memory
(:attr:`~ddco_pyro.model.hierarchy.Hierarchy.steps_at_once`): it stays bounded, and what the networks compute stays in
the cache. With MLP-64 options over 50 × 2000 steps a gradient step takes 0.6 of the time that it takes in one piece."""

NARROWEST = 1e-6
"""A part of a number's range that is narrower, as a share of all of it, is one value, and tells nothing."""


@dataclass(frozen=True)
class Batch:
    """N demonstrations padded to T steps: ``inputs``; ``actions`` [N, T, A'] in scaled units, of the control dimensions
    that vary; ``lengths`` [N]; of vectors that are varied in training, their other ``versions`` [N, V, T, F_key] by
    name.
    """

    inputs: Inputs
    actions: Tensor
    lengths: Tensor
    versions: Mapping[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.lengths)

    @property
    def steps(self) -> int:
        """Steps in all, padding left out."""
        return int(self.lengths.sum())

    def pieces(self, steps: int = STEPS_AT_ONCE) -> Iterator[tuple[Tensor, Batch]]:
        """The whole batch as parts of at most so many steps, padding included, each with its rows; one at least."""
        longest = int(self.lengths.max())
        for rows in torch.arange(len(self)).split(max(steps // longest, 1)):
            yield rows, self.select(rows) if len(rows) < len(self) else self

    def select(self, rows: Tensor, at_most: int | None = None) -> Batch:
        """The demonstrations ``rows`` [M] as they are seen here, padded to the longest among them; their first
        ``at_most`` steps if given.
        """
        lengths = self.lengths[rows].clamp(max=at_most or int(self.lengths.max()))
        steps = int(lengths.max())
        return Batch(self.inputs.part(rows, slice(0, steps)), self.actions[rows, :steps], lengths)

    def varied(self, most: Mapping[str, int], seed: int) -> Batch:
        """The same with the pictures of each demonstration moved at random, and with vectors as they are or as one of
        their other versions.

        :param most: by observation, the most pixels along either axis.
        """
        random = np.random.default_rng(seed)
        shifts = {key: random.integers(-pixels, pixels + 1, (len(self), 2)) for key, pixels in most.items()}
        vectors = dict(self.inputs.vectors)
        for key, others in self.versions.items():
            chosen = torch.as_tensor(random.integers(-1, others.shape[1], len(self)))
            (rows,) = torch.where(chosen >= 0)
            vectors[key] = vectors[key].index_copy(0, rows, others[rows, chosen[rows]])
        varied = Batch(Inputs(vectors, self.inputs.images, self.inputs.time), self.actions, self.lengths)
        return varied._with(lambda images: replace(images, shifts=shifts))

    def read_by(self, readers: Readers) -> Batch:
        """The same with pictures that are in files read by these."""
        return self._with(lambda images: replace(images, readers=readers) if images.stored else images)

    def held(self, device: torch.device) -> Batch:
        """The same with all pictures on a device.

        :raises DemonstrationsError: a file cannot be read.
        """
        return self._with(lambda images: images.held(device))

    @property
    def picture_bytes(self) -> int:
        """Bytes of all pictures as they are seen."""
        return self.inputs.images.size if isinstance(self.inputs.images, Frames) else 0

    def _with(self, change: Callable[[Frames], Frames]) -> Batch:
        images = self.inputs.images
        if not isinstance(images, Frames):
            return self
        return replace(self, inputs=Inputs(self.inputs.vectors, change(images), self.inputs.time))


class ObservationEncoder(nn.Module):
    """Observations by name to one feature vector: differences appended, standardised where the spec says so.

    Where the spec has ``bins``, what networks see of a number x are besides min(max(x, q_k), q_{k+1}) between each two
    neighbouring quantiles q of its different values in the demonstrations given to :meth:`fit`, standardised as x is: a
    piecewise-linear encoding (Gorishniy, Rubachev and Babenko, On embeddings for numerical features in tabular deep
    learning, 2022).

    Mean and standard deviation are those of the demonstrations given to :meth:`fit`, and are kept with the model.
    Pictures are cut and scaled as the spec says when they are read, whether from a file or from memory.

    A dimension that never changes, or by rounding alone (:func:`~ddco_pyro.data.checks.rounding`), is only centred, and
    so are the differences of one that does so within each demonstration: rounding is no feature, and what moves later
    on moves in its own units, not in multiples of a rounding.

    The built-in observation :data:`~ddco_pyro.spec.STEP` is made here: the number of the step divided by ``longest``,
    the steps of the longest demonstration given to :meth:`fit`.
    """

    mean: Tensor
    std: Tensor
    longest: Tensor
    low: Tensor
    high: Tensor
    places: Tensor

    def __init__(self, specs: Sequence[ObservationSpec], shapes: Shapes) -> None:
        super().__init__()
        shapes = {**shapes, STEP: (1,)}
        self.shapes = {spec.key: tuple(shapes[spec.key]) for spec in specs if spec.key != STEP}
        self.specs = tuple(spec for spec in specs if len(shapes[spec.key]) < PICTURE_DIMENSIONS)
        pictures = [spec for spec in specs if len(shapes[spec.key]) == PICTURE_DIMENSIONS]
        self.transforms = {spec.key: _transform(spec) for spec in pictures}
        self.shifts = {spec.key: spec.augment.shift for spec in pictures if spec.augment}
        seen = {spec.key: _seen_shape(spec, shapes) for spec in specs}
        self.images = {spec.key: seen[spec.key] for spec in pictures}
        self.given = [int(np.prod(shapes[spec.key])) * spec.given for spec in self.specs]
        self.sizes = [int(np.prod(shapes[spec.key])) * spec.seen for spec in self.specs]
        self.register_buffer("mean", torch.zeros(sum(self.sizes), dtype=torch.float64))
        self.register_buffer("std", torch.ones(sum(self.sizes), dtype=torch.float64))
        if self.has_bins:
            self.register_buffer("places", torch.as_tensor(self._places()), persistent=False)
            self.register_buffer("low", torch.full_like(self.mean, -torch.inf))
            self.register_buffer("high", torch.full_like(self.mean, torch.inf))
        if STEP in self.keys:
            self.register_buffer("longest", torch.ones((), dtype=torch.float64))

    @property
    def steps_seen(self) -> int:
        """Steps of which the features and pictures of one are made: it, and those before it."""
        return max([2, *(transform.frames for transform in self.transforms.values())])

    @property
    def keys(self) -> list[str]:
        """The vectors, in the spec's order."""
        return [spec.key for spec in self.specs]

    def shape(self, steps: int) -> InputShape:
        """What networks are built for."""
        return InputShape(dict(zip(self.keys, self.sizes, strict=True)), self.images, steps)

    def fit(self, demonstrations: Demonstrations) -> None:
        """Take mean and standard deviation, and the parts of the range, from every step of these demonstrations, and
        the longest of them.
        """
        if STEP in self.keys:
            self.longest.fill_(max(demonstrations.lengths))
        each = [self.features(demo.observations) for demo in demonstrations]
        moves, rows = self._moves(each, demonstrations), np.concatenate(each)
        if self.has_bins:
            self._fit_bins(rows)
            places, cut = self.places.numpy(), self._cut(torch.as_tensor(rows)).numpy()
            moves = moves[places] & (np.ptp(cut, axis=0) > NARROWEST * np.ptp(rows, axis=0)[places])
            rows = cut
        standardize = np.repeat(np.array([spec.standardize for spec in self.specs], dtype=bool), self.sizes)
        changes = standardize & moves
        self.mean.copy_(torch.as_tensor(np.where(standardize, rows.mean(0), 0.0)))
        self.std.copy_(torch.as_tensor(np.where(changes, rows.std(0), 1.0)))

    @property
    def has_bins(self) -> bool:
        """Whether any number is seen in parts of its range, too."""
        return any(spec.bins for spec in self.specs)

    def _places(self) -> np.ndarray:
        """Which of the features [F] each number is that networks see: those of a key as they are, then bin by bin."""
        firsts = np.cumsum([0, *self.given])
        rows = zip(self.specs, firsts, self.given, strict=False)
        return np.concatenate([np.tile(np.arange(first, first + count), 1 + spec.bins) for spec, first, count in rows])

    def _fit_bins(self, rows: np.ndarray) -> None:
        """Take the ends of each part from ``rows`` [T, F]: values that there are, with as many different ones between
        each two. A value that most steps have is one of them: it does not leave all others to a single part.
        """
        at = 0
        for spec, count, size in zip(self.specs, self.given, self.sizes, strict=True):
            own = rows[:, self.places[at : at + count].numpy()]
            ends = torch.as_tensor(np.column_stack([_ends(values, spec.bins) for values in own.T]))
            self.low[at + count : at + size] = ends[:-1].flatten()
            self.high[at + count : at + size] = ends[1:].flatten()
            at += size

    def _cut(self, features: Tensor) -> Tensor:
        """Features [..., F] as they are, and cut off at the ends of each part."""
        if not self.has_bins:
            return features
        return torch.minimum(torch.maximum(features[..., self.places], self.low), self.high)

    def scaled(self, features: np.ndarray) -> np.ndarray:
        """Features [T, F] as networks see them [T, F'], in double precision."""
        return ((self._cut(torch.as_tensor(features)) - self.mean) / self.std).numpy()

    def _moves(self, rows: Sequence[np.ndarray], demonstrations: Demonstrations) -> np.ndarray:
        """Which features [F] of these demonstrations' ``rows`` [T_n, F] vary by more than rounding; differences do
        where their dimension does within a demonstration.
        """
        low, high = (np.stack([end(part, axis=0) for part in rows]) for end in (np.min, np.max))
        moves, first = [np.zeros(0, dtype=bool)], 0
        for spec, size in zip(self.specs, self.given, strict=True):
            arrays = [] if spec.key == STEP else [demo.observations[spec.key] for demo in demonstrations]
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

        :param times: the number of each step [T]; 0 to T - 1 where it is not given.
        """
        steps = len(next(iter(observations.values())))
        times = np.arange(steps) if times is None else times
        columns: list[np.ndarray] = [np.zeros((steps, 0))]
        for spec in self.specs:
            values = times / float(self.longest) if spec.key == STEP else observations[spec.key]
            column = np.asarray(values, dtype=np.float64).reshape(steps, -1)
            columns.append(column)
            if spec.differences:
                columns.append(np.diff(column, axis=0, prepend=column[:1]))
        return np.concatenate(columns, axis=1)

    def standardized(self, features: Tensor) -> dict[str, Tensor]:
        """Features [..., F] as networks see them, [..., F_key] by name."""
        vector = ((self._cut(features) - self.mean) / self.std).float()
        # A split into nothing cannot be read again from an exported program.
        return dict(zip(self.keys, vector.split(self.sizes, -1), strict=True)) if self.sizes else {}

    def inputs(self, observations: Iterable[Mapping[str, Observed]], times: np.ndarray | None = None) -> Inputs:
        """Sequences of observations, each [T_n, ...] by name, to padded network inputs, whose pictures are read when
        they are asked for; ``times`` as in :meth:`features`.
        """
        sequences = list(observations)
        vectors = [self.scaled(self.features(sequence, times)) for sequence in sequences]
        vector = _pad(vectors).float()
        by_key, steps = dict(zip(self.keys, vector.split(self.sizes, -1), strict=True)), vector.shape[1]
        pictures = {key: tuple(_pictures(sequence[key]) for sequence in sequences) for key in self.images}
        rows = tuple(range(len(sequences)))
        images = Frames(pictures, self.transforms, rows, slice(0, steps)) if pictures else {}
        return Inputs(by_key, images, torch.arange(steps))

    def versions(self, demonstrations: Demonstrations) -> dict[str, Tensor]:
        """The other versions of vectors that are varied in training, as networks see them, [N, V, T, F_key] by name."""
        named = {spec.key: spec.augment.versions for spec in self.specs if spec.augment and spec.augment.versions}
        return {
            key: torch.stack(
                [
                    self.inputs(
                        {**demo.observations, key: np.asarray(demo.observations[name])[:, version]}
                        for demo in demonstrations
                    ).vectors[key]
                    for version in range(demonstrations.observation_shapes[name][0])
                ],
                dim=1,
            )
            for key, name in named.items()
        }


LARGEST_SCALED = 1e12
"""No feature or control may be larger, once it is scaled: float32 has to hold the square of what networks make of it,
divided by that of a small σ, and ends at 3e38."""


def encode(
    demonstrations: Demonstrations, encoder: ObservationEncoder, scaling: ControlScaling, fitted: bool = False
) -> Batch:
    """All demonstrations as one padded batch.

    :param fitted: whether the model is fitted already, so that nothing can be declared any more.
    :raises DemonstrationsError: a number is too large for networks.
    """
    refuse_unusable(demonstrations, encoder, scaling, fitted)
    inputs = encoder.inputs(demo.observations for demo in demonstrations)
    actions = _pad([scaling.scaled(demo.actions) for demo in demonstrations]).float()
    return Batch(inputs, actions, torch.tensor([len(demo) for demo in demonstrations]))


def refuse_unusable(
    demonstrations: Demonstrations, encoder: ObservationEncoder, scaling: ControlScaling, fitted: bool = False
) -> None:
    """See that networks can take every feature, and the emissions every control.

    :raises DemonstrationsError: a number is larger than :data:`LARGEST_SCALED` once it is scaled, or a control has a
        value that it cannot have.
    """
    refuse_impossible(demonstrations, scaling, fitted)
    places = np.repeat([f"obs/{spec.key}" for spec in encoder.specs], encoder.sizes)
    for demo in demonstrations:
        features = encoder.scaled(encoder.features(demo.observations))
        controls = scaling.scaled(demo.actions)
        sizes = np.abs(np.concatenate([features, controls], axis=1))
        if (sizes > LARGEST_SCALED).any():
            step, column = np.argwhere(sizes > LARGEST_SCALED)[0]
            place = places[column] if column < len(places) else "actions"
            raise DemonstrationsError(
                f"{demo.name}: {place} at step {step} is {sizes[step, column]:.2g} once it is scaled, and networks "
                f"take at most {LARGEST_SCALED:g}; repair it, or leave {demo.name} out (demonstrations.exclude)"
            )


def _ends(values: np.ndarray, bins: int) -> np.ndarray:
    """The ends [bins + 1] of parts of the range of ``values`` [T] that hold equally many different values."""
    return np.asarray(np.quantile(np.unique(values), np.linspace(0, 1, bins + 1), method="nearest"))


def _transform(spec: ObservationSpec) -> Transform:
    return Transform(spec.crop, spec.resize, spec.grey, spec.frames)


def _seen_shape(spec: ObservationSpec, shapes: Shapes) -> tuple[int, ...]:
    """What is seen of a step of an observation.

    :raises ShapeError: it cannot be cut, scaled or varied as the spec says.
    """
    stored = shapes[spec.key]
    if spec.bins and len(stored) == PICTURE_DIMENSIONS:
        raise ShapeError(f"observations: {spec.key!r} has pictures: bins are for vectors")
    if spec.augment:
        _refuse_other_versions(spec.key, spec.augment, shapes)
    try:
        return _transform(spec).shape(stored)
    except TransformError as error:
        raise ShapeError(f"observations: {spec.key!r} {error}") from error


def _refuse_other_versions(key: str, augment: AugmentSpec, shapes: Shapes) -> None:
    """See that an observation can be varied so; versions are not there where a model is read again.

    :raises ShapeError: it cannot.
    """
    stored, versions = shapes[key], augment.versions
    picture = len(stored) == PICTURE_DIMENSIONS
    if augment.shift and not picture:
        raise ShapeError(f"observations: {key!r} has shape {list(stored)} at each step: augment.shift is for pictures")
    if versions is None:
        return
    if picture:
        raise ShapeError(f"observations: {key!r} has pictures: augment.versions is for vectors; shift moves pictures")
    there = shapes.get(versions)
    if there is not None and (not there or not there[0] or there[1:] != stored):
        raise ShapeError(
            f"observations: {key!r} augment.versions: {versions!r} has shape {list(there)} at each step, it has to be "
            f"[versions{''.join(f', {size}' for size in stored)}]"
        )


def _pictures(values: Observed) -> Observed:
    return values if isinstance(values, Pictures) else np.asarray(values)


def _pad(sequences: Sequence[np.ndarray]) -> Tensor:
    """[T_n, ...] arrays to one [N, max T_n, ...] tensor, zeros at the end."""
    return nn.utils.rnn.pad_sequence([torch.as_tensor(sequence) for sequence in sequences], batch_first=True)
