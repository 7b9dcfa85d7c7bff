"""Pictures as networks read them: cropped, scaled, shifted, and padded to a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ddco_pyro.data.arrays import PICTURE_DIMENSIONS, Observed, blocks
from ddco_pyro.errors import BadInput


class TransformError(BadInput):
    """Pictures cannot be cropped or scaled as asked."""


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
            wanted = "crop and resize are for pictures [H, W, C]"
            raise TransformError(f"has shape {list(stored)} at each step: {wanted}")
        height, width, colours = stored
        if self.crop is not None:
            top, left, *size = self.crop
            if top + size[0] > height or left + size[1] > width:
                crop = ", ".join(map(str, self.crop))
                raise TransformError(f"crop: [{crop}] is not within {height} × {width} pixels")
            height, width = size
        return *(self.resize or (height, width)), colours

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
        for seen in (transform(block) for block in blocks(array, steps)):
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
