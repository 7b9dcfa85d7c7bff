"""Pictures: lazy arrays in files, crops and scaling, and padded batches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ddco_pyro.data.hdf5 import DAMAGE, DemonstrationsError, opened
from ddco_pyro.errors import BadInput

BLOCK_BYTES = 16 * 2**20
"""Most bytes of an array that are read at a time in a pass over the whole array; one step at least."""

PICTURE_DIMENSIONS = 3
"""A step of pictures is [H, W, C]."""

CHANNELS = (1, 3, 4)
"""Grey; red, green and blue; three colours with transparency or depth."""


class TransformError(BadInput):
    """Pictures cannot be cropped or scaled as asked."""


def channels_last(shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, ...]:
    """The shape [T, H, W, C] of pictures stored as [T, C, H, W] or [T, H, W]; any other shape unchanged.

    Arrays of unsigned 8 or 16 bits are pictures if both sides are longer than 4 pixels and channels, if any, number 1,
    3 or 4. Pictures without a channel axis are grey.
    """
    sides, most = shape[-2:], max(CHANNELS)
    if dtype not in (np.uint8, np.uint16) or min(sides, default=0) <= most:
        return shape
    if len(shape) == PICTURE_DIMENSIONS:
        return (*shape, 1)
    if len(shape) == 1 + PICTURE_DIMENSIONS and shape[1] in CHANNELS:
        return (shape[0], *sides, shape[1])
    return shape


def turned(array: np.ndarray) -> np.ndarray:
    """Pictures with their channels last (:func:`channels_last`); any other array unchanged."""
    shape = channels_last(array.shape, array.dtype)
    if shape == array.shape:
        return array
    return array[..., None] if array.ndim == PICTURE_DIMENSIONS else np.ascontiguousarray(np.moveaxis(array, 1, -1))


# --- in files ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pictures:
    """A lazy array of pictures uint8 [T, H, W, C] in an HDF5 file; slices are read on access.

    :param path: the file, opened for each slice.
    :param place: the dataset in the file.
    :param where: name in errors, such as ``demo_0: obs/camera``.
    :param stored: shape of the dataset, whose channels may come first or be absent.
    """

    path: str
    place: str
    where: str
    stored: tuple[int, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """[T, H, W, C]."""
        return channels_last(self.stored, self.dtype)

    @property
    def dtype(self) -> np.dtype[np.uint8]:
        """Always uint8."""
        return np.dtype(np.uint8)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, steps: Any) -> np.ndarray:
        """The pictures of a slice of steps or of one step; any other index reads all pictures.

        :raises DemonstrationsError: the file cannot be read, or has changed.
        """
        if isinstance(steps, int | np.integer):
            step = range(len(self))[steps]
            return np.asarray(self[step : step + 1][0])
        if not isinstance(steps, slice):
            return np.asarray(np.asarray(self)[steps])
        first, last, stride = steps.indices(len(self))
        with opened(self.path) as file:
            dataset = file.get(self.place)
            if getattr(dataset, "shape", None) != self.stored or dataset.dtype != self.dtype:
                raise DemonstrationsError(f"{self.where} has changed since it was looked at; do the same again")
            try:
                return turned(np.asarray(dataset[first:last:stride]))
            except DAMAGE as error:
                raise DemonstrationsError(f"{self.where} cannot be read ({error}); the file may be damaged") from error

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """All pictures, in memory."""
        return self[:].astype(dtype or self.dtype, copy=False)


Observed = np.ndarray | Pictures
"""An observation of a demonstration [T, ...], in memory or, for pictures, in a file."""


def blocks(array: Observed) -> Iterator[np.ndarray]:
    """An array [T, ...] in blocks of consecutive steps."""
    at_once = block_steps(array.shape[1:], array.dtype)
    for first in range(0, len(array), at_once):
        yield array[first : first + at_once]


def block_steps(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Number of steps of this shape in a block."""
    return max(1, BLOCK_BYTES // max(1, math.prod(shape) * dtype.itemsize))


def same(left: Observed, right: Observed) -> bool:
    """Whether two arrays are equal; arrays in files are compared block by block."""
    if left.shape != right.shape:
        return False
    if isinstance(left, np.ndarray) and isinstance(right, np.ndarray):
        return np.array_equal(left, right)
    at_once = block_steps(left.shape[1:], left.dtype)
    firsts = range(0, len(left), at_once)
    return all(np.array_equal(left[first : first + at_once], right[first : first + at_once]) for first in firsts)


# --- as networks read them --------------------------------------------------------------------------------------------


class Transform(NamedTuple):
    """The preprocessing of pictures: crop, then scale.

    :param crop: top, left, height, width in the file's pixels; None for no crop.
    :param resize: height and width after scaling; None for no scaling.
    """

    crop: tuple[int, ...] | None = None
    resize: tuple[int, ...] | None = None

    def as_data(self) -> dict[str, Any]:
        """The settings that differ from their defaults, as plain data."""
        return {key: value for key, value in self._asdict().items() if value != self._field_defaults[key]}

    def shape(self, stored: Sequence[int]) -> tuple[int, ...]:
        """[H', W', C] of preprocessed pictures [H, W, C].

        :raises TransformError: the crop leaves the picture, or there are no pictures.
        """
        if self == Transform():
            return tuple(stored)
        if len(stored) != PICTURE_DIMENSIONS:
            raise TransformError(f"has shape {list(stored)} at each step: crop and resize are for pictures [H, W, C]")
        height, width, colours = stored
        if self.crop is not None:
            top, left, *size = self.crop
            if top + size[0] > height or left + size[1] > width:
                raise TransformError(
                    f"crop: [{', '.join(map(str, self.crop))}] is not within {height} × {width} pixels"
                )
            height, width = size
        return *(self.resize or (height, width)), colours

    def seen(self, array: Observed, steps: slice) -> Iterator[np.ndarray]:
        """Preprocessed pictures of consecutive steps, [steps, H', W', C], block by block.

        :raises DemonstrationsError: a file cannot be read.
        """
        last, at_once = min(steps.stop, len(array)), block_steps(array.shape[1:], array.dtype)
        for first in range(steps.start, last, at_once):
            yield self(array[first : min(first + at_once, last)])

    def __call__(self, frames: np.ndarray) -> np.ndarray:
        """Pictures [T, H, W, C] to [T, H', W', C]."""
        if self.crop is not None:
            top, left, height, width = self.crop
            frames = frames[:, top : top + height, left : left + width]
        if self.resize is not None and frames.shape[1:3] != self.resize:
            frames = resized(frames, self.resize)
        return frames


def resized(frames: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Pictures [T, H, W, C] scaled by area averaging (cv2's INTER_AREA) to height and width ``size``."""
    import cv2

    height, width = size
    scaled = np.empty((len(frames), height, width, frames.shape[-1]), frames.dtype)
    for number, frame in enumerate(frames):
        one = cv2.resize(np.ascontiguousarray(frame), (width, height), interpolation=cv2.INTER_AREA)
        scaled[number] = one.reshape(scaled.shape[1:])
    return scaled


def padded(
    frames: Sequence[Observed], steps: slice, transform: Transform, shifts: np.ndarray | None = None
) -> np.ndarray:
    """Preprocessed pictures of several demonstrations, [N, steps, H, W, C], zero beyond their ends.

    :param shifts: rows and columns by which the pictures of each demonstration are shifted, [N, 2].
    :raises DemonstrationsError: a file cannot be read.
    """
    shape = transform.shape(frames[0].shape[1:])
    whole = np.zeros((len(frames), steps.stop - steps.start, *shape), frames[0].dtype)
    for row, array in enumerate(frames):
        at = 0
        for seen in transform.seen(array, steps):
            target = whole[row, at : at + len(seen)]
            shift_into(target, seen, *((0, 0) if shifts is None else shifts[row].tolist()))
            at += len(seen)
    return whole


def shift_into(target: np.ndarray, frames: np.ndarray, down: int, right: int) -> None:
    """Write pictures [T, H, W, C] into ``target``, shifted by whole pixels; the edge is repeated."""
    height, width = frames.shape[1:3]
    down, right = (max(1 - size, min(size - 1, by)) for size, by in ((height, down), (width, right)))
    top, left, bottom, end = max(down, 0), max(right, 0), height + min(down, 0), width + min(right, 0)
    target[:, top:bottom, left:end] = frames[:, top - down : bottom - down, left - right : end - right]
    target[:, top:bottom, :left] = target[:, top:bottom, left : left + 1]
    target[:, top:bottom, end:] = target[:, top:bottom, end - 1 : end]
    target[:, :top] = target[:, top : top + 1]
    target[:, bottom:] = target[:, bottom - 1 : bottom]
