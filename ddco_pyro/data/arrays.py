"""Arrays [T, ...] of demonstrations, in memory or lazy: what networks read of them, whether there is room."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ddco_pyro.data.errors import DemonstrationsError

NUMBERS = "fiub"
"""Kinds of numpy types that are real numbers."""

LARGEST = 1e30
"""Largest usable number: networks are float32, which ends at 3e38, variances float64, which ends at 1e308."""

BLOCK_BYTES = 16 * 2**20
"""Most bytes of an array that are read at a time in a pass over the whole array; one step at least."""

PICTURE_DIMENSIONS = 3
"""A step of pictures is [H, W, C]."""

CHANNELS = (1, 3, 4)
"""Grey; red, green and blue; three colours with transparency or depth."""

PICTURES = np.dtype(np.uint8)
"""The type of pictures that networks read."""


@dataclass(frozen=True)
class LazyArray:
    """An array [T, ...] that is read when asked for: a slice of its steps, or all of it by ``np.asarray``.

    :param read: gives the steps from ``start`` to before ``stop`` in blocks.
    :param where: name in errors, such as ``demo_0: obs/camera``.
    :param file: the file with these very values; empty where they are decoded or computed.
    :param video: whether reading decodes a video.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    read: Callable[[int, int], Iterator[np.ndarray]]
    where: str = ""
    file: str = ""
    video: bool = False

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, steps: Any) -> np.ndarray:
        """The values of a slice of steps or of one step; any other index reads all values.

        :raises DemonstrationsError: the file cannot be read, or has changed.
        """
        if isinstance(steps, int | np.integer):
            step = range(len(self))[steps]
            return np.asarray(self[step : step + 1][0])
        if not isinstance(steps, slice):
            return np.asarray(np.asarray(self)[steps])
        first, last, stride = steps.indices(len(self))
        whole, at = np.zeros((max(last - first, 0), *self.shape[1:]), self.dtype), 0
        for block in self.read(first, last):
            whole[at : at + len(block)] = block
            at += len(block)
        return whole[::stride]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        size = self.dtype.itemsize * math.prod(self.shape)
        refuse_too_much(size, self.where or "an array", "divide the episode")
        return self[:].astype(dtype or self.dtype, copy=False)


Observed = np.ndarray | LazyArray
"""An observation of a demonstration [T, ...], in memory or lazy."""


def blocks(array: Observed, steps: slice = slice(None)) -> Iterator[np.ndarray]:
    """Consecutive steps of an array [T, ...] in blocks."""
    start, stop, _ = steps.indices(len(array))
    if isinstance(array, LazyArray):
        return array.read(start, stop)
    at_once = block_steps(array.shape[1:], array.dtype)
    return (array[first : min(first + at_once, stop)] for first in range(start, stop, at_once))


def block_steps(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Number of steps of this shape in a block."""
    return max(1, BLOCK_BYTES // max(1, math.prod(shape) * dtype.itemsize))


def in_blocks(pictures: Iterable[np.ndarray], size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Pictures [H, W, 3] one after the other, ``size`` [H, W] each, in blocks [steps, H, W, 3]."""
    rest = iter(pictures)
    while block := list(islice(rest, block_steps((*size, 3), PICTURES))):
        yield np.stack(block)


def same(left: Observed, right: Observed) -> bool:
    """Whether two arrays are equal; arrays in files are compared block by block."""
    if left.shape != right.shape:
        return False
    at_once = block_steps(left.shape[1:], left.dtype)
    parts = (slice(first, first + at_once) for first in range(0, len(left), at_once))
    return all(np.array_equal(left[part], right[part]) for part in parts)


def usable(values: np.ndarray) -> np.ndarray:
    """Whether each real number is finite and at most :data:`LARGEST` in size."""
    if values.dtype.kind != "f":
        return np.ones(values.shape, dtype=bool)
    return np.abs(values) <= min(LARGEST, float(np.finfo(values.dtype).max))  # false for NaN


# --- pictures -----------------------------------------------------------------------------------------------


def is_picture(array: Observed) -> bool:
    """Whether a step of an array [T, ...] is a picture, uint8 [H, W, C]."""
    return array.dtype == PICTURES and len(array.shape) == 1 + PICTURE_DIMENSIONS


def in_file(array: Observed) -> bool:
    """Whether an array is pictures that stay in their file until they are shown or a network reads them."""
    return isinstance(array, LazyArray) and bool(array.file) and is_picture(array)


def channels_last(shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[int, ...]:
    """The shape [T, H, W, C] of pictures stored as [T, C, H, W] or [T, H, W]; any other shape unchanged.

    Arrays of unsigned 8 or 16 bits are pictures if both sides are longer than 4 pixels and channels, if any,
    number 1, 3 or 4. Pictures without a channel axis are grey.
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
    if array.ndim == PICTURE_DIMENSIONS:
        return array[..., None]
    return np.ascontiguousarray(np.moveaxis(array, 1, -1))


# --- what networks read -------------------------------------------------------------------------------------


def network_input(
    shape: tuple[int, ...], dtype: np.dtype[Any] = PICTURES
) -> tuple[Literal["vector", "picture", ""], str]:
    """What networks read of an observation whose steps have this shape and type, else why they read nothing.

    Real numbers of at most two dimensions are a vector, flattened. A picture is uint8 [H, W, C].

    >>> network_input((4, 4), np.dtype(np.float32)), network_input((48, 64, 3))
    (('vector', ''), ('picture', ''))
    """
    if dtype.kind not in NUMBERS:
        return "", no_numbers(dtype)
    if 0 in shape:
        return "", f"has shape {list(shape)} at each step, and so no numbers"
    if len(shape) < PICTURE_DIMENSIONS:
        return "vector", ""
    if len(shape) > PICTURE_DIMENSIONS:
        has = f"has shape {list(shape)} at each step, and networks read vectors and pictures [H, W, C]"
        return "", f"{has}; store one picture a step, or reshape it to [steps, dimensions]"
    if dtype == PICTURES:
        return "picture", ""
    has = f"has shape {list(shape)} at each step and is not uint8, as pictures have to be"
    such = "such as (255 * (depth / far).clip(0, 1)).astype('uint8')"
    return "", f"{has}; scale the range that matters to it, {such}"


def no_numbers(dtype: np.dtype[Any]) -> str:
    """The problem with an array of something else than numbers, in words."""
    text = dtype.kind in "STU" or h5py.check_string_dtype(dtype)
    return f"holds {'text' if text else 'text or other objects' if dtype.kind == 'O' else dtype}, not numbers"


# --- memory: no number of a result depends on it ------------------------------------------------------------

PROGRAM = 680e6
"""Bytes of a fit to next to nothing: mostly torch, Pyro and compiled code."""

INFERENCE = 5e3
"""Bytes of inference per step of trajectories that are processed together."""

SMALL = 1e6
"""Bytes that are taken without asking how many are free."""


def free(root: Path = Path("/")) -> float:
    """Free bytes of the machine, at most the limits of this process's control groups.

    :param root: the folder that holds ``proc`` and ``sys``.
    """
    found = [float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))]
    try:
        facts = (root / "proc/meminfo").read_text()
        available = re.search(r"^MemAvailable:\s+(\d+) kB$", facts, re.MULTILINE)
        found += [float(available[1]) * 1024] if available else []
        group = (root / "proc/self/cgroup").read_text().strip().rpartition("::")[2]
        top = root / "sys/fs/cgroup"
        own = top / group.strip("/")
        limits = [part / "memory.max" for part in (own, *own.parents) if part.is_relative_to(top)]
        found += [float(file.read_text()) for file in limits if file.exists() and file.read_text() != "max\n"]
    except (OSError, ValueError):
        pass  # not Linux
    return min(found)


def refuse_too_much(needed: float, what: str, remedy: str) -> None:
    """Refuse work that needs more memory than is :func:`free`.

    :param what: subject of the error's sentence.
    :raises DemonstrationsError: it does.
    """
    if needed >= SMALL and needed > (there := free()):
        size = math.ceil(needed / 1e8) / 10
        takes = f"{what} takes about {size:g} GB of memory"
        raise DemonstrationsError(f"{takes}, and {there / 1e9:.4g} are free; {remedy}")
