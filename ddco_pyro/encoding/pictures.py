"""The pictures of a file's demonstrations, read in blocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain, islice

import numpy as np

from ddco_pyro.data.checks import check, check_alike, problems_of_masks
from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources import Column
from ddco_pyro.data.sources.robomimic import Robomimic
from ddco_pyro.errors import nearest

AT_ONCE = 32
"""Pictures of a call of the encoder, whatever the blocks in which they are read: the last bits of a network's numbers
depend on how many there are."""

BUFFER_BYTES = 16 * 2**20
"""Bytes of the buffer from which pictures are drawn at random; it holds at least :data:`AT_ONCE` pictures."""


class Pictures:
    """The pictures [H, W, C] under one observation key of an open file.

    ``training`` names the demonstrations to train with: ``mask/train``, else those not in ``mask/valid``.

    :param source: an open file of demonstrations.
    :param key: the observation.
    :raises DemonstrationsError: the observation is missing or no picture, or the demonstrations are refused or differ.
    """

    def __init__(self, source: Robomimic, key: str) -> None:
        self._source, self.key = source, key
        first, self._lengths = source.recording(source.names[0]), dict[str, int]()
        if key not in first.observations:
            known = [name for name, column in first.observations.items() if column.image]
            there = ", ".join(known) or "none"
            raise DemonstrationsError(f"there is no observation {key!r}{nearest(key, known)}; pictures are: {there}")
        column = first.observations[key]
        if not column.image:
            had = f"{column.dtype} {[*column.shape]}"
            raise DemonstrationsError(f"obs/{key} is {had}; pictures are uint8 [steps, height, width, channels]")
        for name in source.names:
            recording = source.recording(name)
            check(recording)
            check_alike(recording, first)
            if not recording.observations[key].image:
                raise DemonstrationsError(f"{name}: obs/{key} is no picture, in {first.name} it is")
            self._lengths[name] = recording.actions.shape[0]
        self.shape, masks = column.shape[1:], source.masks
        for problem in problems_of_masks(masks, source.names):
            raise DemonstrationsError(problem)
        held_out = set(masks.get("valid", ()))
        self.training = tuple(masks.get("train", (name for name in source.names if name not in held_out)))
        if not self.training:
            raise DemonstrationsError("no demonstration is left to train with; change the masks")
        if not math.prod(self.shape):
            raise DemonstrationsError(f"obs/{key}: pictures of shape {self.shape} are empty")

    @property
    def number(self) -> int:
        """Pictures of all training demonstrations."""
        return sum(self._lengths[name] for name in self.training)

    def of(self, name: str) -> Iterator[np.ndarray]:
        """The pictures of a demonstration in order, [M, H, W, C]."""
        return batches(self._source.recording(name, (self.key,), ()).observations[self.key], AT_ONCE)

    def at_random(self, seed: int, epoch: int) -> Iterator[np.ndarray]:
        """Every training picture [H, W, C] once, in an order that seed and epoch decide.

        Demonstrations are read in random order, and their pictures leave a buffer in random order.
        """
        random = np.random.default_rng((seed, epoch))
        names = [self.training[index] for index in random.permutation(len(self.training))]
        size = min(self.number, max(AT_ONCE, BUFFER_BYTES // math.prod(self.shape)))
        buffer = np.empty((size, *self.shape), np.uint8)
        frames = chain.from_iterable(chain.from_iterable(map(self.of, names)))
        for place, frame in enumerate(islice(frames, size)):
            buffer[place] = frame
        for frame in frames:
            drawn = random.integers(size)
            yield buffer[drawn].copy()
            buffer[drawn] = frame
        yield from (buffer[rest].copy() for rest in random.permutation(size))


def batches(column: Column, size: int) -> Iterator[np.ndarray]:
    """An array in pieces of ``size`` steps, whatever its blocks; the last piece may be shorter."""
    rest = np.empty((0, *column.shape[1:]), column.dtype)
    for block in column.blocks():
        rest = np.concatenate([rest, block]) if len(rest) else block
        whole = len(rest) // size * size
        yield from (rest[start : start + size] for start in range(0, whole, size))
        rest = rest[whole:].copy()
    if len(rest):
        yield rest
