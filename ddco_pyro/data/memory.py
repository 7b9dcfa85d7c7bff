"""How much memory a fit may take, and whether what has to be in memory fits into it: said before it is read.

What is free on the machine decides what is refused, and nothing else: bits do not depend on it.

What networks compute, and pictures in a file, take as much as they are given (:func:`share`); vectors, controls and
what the inference keeps of each step are there as a whole.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.errors import BadInput

VARIABLE = "DDCO_PYRO_MEMORY"
ORDINARY = 2e9
"""Bytes that chunks are cut for where ``$DDCO_PYRO_MEMORY`` says nothing: how they are cut decides last digits."""

UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}

PROGRAM = 680e6
"""Bytes that a fit of next to nothing takes: mostly torch, Pyro and compiled code."""

KEPT = 4.0
"""Bytes that a fit keeps of a feature or control of a padded step, beside the demonstrations: float32."""

MAKING = 16.0
"""Bytes that a number takes on the way there, two float64, or while it is clustered: float64 and k-means' copy."""

BACKWARD, AGAIN = 1.5, 2.25
"""Bytes that a gradient step takes for a byte that networks keep of a step, whose gradient is there for a while too;
and where a trajectory is so long that its chunks are computed again."""

SMALL, HOLED = 160e6, 3.0
"""Networks that take less than this for their steps have tensors of less than 32 MB each; and what they then take
instead of ``BACKWARD``. Once freed those tensors stay in the C library's heap, in holes that the next ones fill in
part, and not alike from run to run; larger ones are given back."""

INFERENCE = 5e3
"""Bytes that inference takes for a step of trajectories that are processed together."""


class Array(Protocol):
    """An array that need not be in memory; its pictures may stay in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """[T, ...]."""

    @property
    def dtype(self) -> np.dtype:
        """What it holds."""


@dataclass(frozen=True)
class Work:
    """What training and evaluating a model takes beside the demonstrations.

    :param batch: trajectories in a gradient step.
    :param steps: steps of several trajectories that go through the networks together.
    :param chunk: steps of a long trajectory that do.
    :param bytes_per_step: bytes that the networks take for each of them.
    :param clustered: numbers that are clustered to begin with.
    """

    batch: int
    steps: int
    chunk: int
    bytes_per_step: int
    clustered: int


@dataclass(frozen=True)
class Extent:
    """How much there is of demonstrations, by their headers.

    :param lengths: steps of each.
    :param size: bytes of all that is read, as it is in memory; pictures that stay in their file do not count.
    :param shapes: by place (``actions``, ``obs/<key>``) the shape of a step.
    :param pictures: the places that hold pictures, uint8.
    """

    lengths: tuple[int, ...]
    size: int
    shapes: Mapping[str, tuple[int, ...]]
    pictures: frozenset[str]

    @classmethod
    def of(cls, demonstrations: Iterable[Mapping[str, Array]]) -> Extent:
        """Of arrays by place for each demonstration; labels count where they are read only."""
        lengths, size = [], 0
        shapes: dict[str, tuple[int, ...]] = {}
        pictures: set[str] = set()
        for arrays in demonstrations:
            lengths.append(arrays["actions"].shape[0] if arrays["actions"].shape else 0)
            for place, array in arrays.items():
                plain = array.dtype == np.uint8
                stays = getattr(array, "kept", None) is not None
                size += 0 if stays else math.prod(array.shape) * (1 if plain else 8)
                if not place.startswith("labels/"):
                    shapes[place] = max(shapes.get(place, ()), tuple(array.shape[1:]), key=math.prod)
                    pictures |= {place} if plain and len(array.shape) == 4 else set()
        return cls(tuple(lengths), size, shapes, frozenset(pictures))

    def features(self, seen: Mapping[str, int]) -> int:
        """Numbers of a step that are no pictures.

        :param seen: by place, how many numbers networks see for each that is observed; one where it is not named.
        """
        numbers = {place: math.prod(shape) for place, shape in self.shapes.items() if place not in self.pictures}
        return sum(count * seen.get(place, 1) for place, count in numbers.items())

    def step(self, seen: Mapping[str, int]) -> float:
        """Bytes of a step's vectors as networks are given them, and of what is made on the way there."""
        return (KEPT + MAKING) * self.features(seen)

    def fit(self, works: Iterable[Work], seen: Mapping[str, int]) -> float:
        """Bytes that a fit takes, about: the most that one of its models does, which are trained one after the other.

        The vectors are there as they were read, and padded. What else there is comes one after the other: what is made
        of them, clusters, and gradient steps.
        """
        longest, features = max(1, *self.lengths), self.features(seen)
        padded, given = len(self.lengths) * longest, KEPT * features
        passing = [MAKING * features * padded]
        for work in works:
            batch, together = (min(n, len(self.lengths)) for n in (work.batch, max(work.steps // longest, 1)))
            kept = min(together * longest, work.chunk) * work.bytes_per_step
            networks = kept * (HOLED if kept < SMALL else AGAIN if longest > work.chunk else BACKWARD)
            passing += [MAKING * work.clustered, longest * (batch * given + together * (given + INFERENCE)) + networks]
        return PROGRAM + self.size + padded * given + max(passing)


def allowed() -> float:
    """Bytes that may be taken: what ``$DDCO_PYRO_MEMORY`` says, or what is free.

    :raises BadInput: ``$DDCO_PYRO_MEMORY`` is not a positive number, perhaps with a unit.
    """
    return _said() or _free()


def _free(root: Path = Path("/")) -> float:
    """Bytes that are free on the machine, at most the limit of the control groups that this process is in.

    :param root: the folder that has ``proc`` and ``sys``.
    """
    found = [float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))]
    try:
        available = re.search(r"^MemAvailable:\s+(\d+) kB$", (root / "proc/meminfo").read_text(), re.MULTILINE)
        found += [float(available[1]) * 1024] if available else []
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, group = line.split(":", 2)
            if not controllers or "memory" in controllers.split(","):
                name = "memory.limit_in_bytes" if controllers else "memory.max"
                top = root / "sys/fs/cgroup" / ("memory" if controllers else "")
                own = top / group.strip("/")
                limits = (part / name for part in (own, *own.parents) if part == top or top in part.parents)
                found += [float(file.read_text()) for file in limits if file.exists() and file.read_text() != "max\n"]
    except (OSError, ValueError):
        pass  # another system than Linux
    return min(found)


def _said() -> float | None:
    """Bytes that ``$DDCO_PYRO_MEMORY`` allows; None where it says nothing.

    :raises BadInput: it is not a positive number, perhaps with a unit.
    """
    text = os.environ.get(VARIABLE)
    if text is None:
        return None
    said = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([KMGT]?B)?\s*", text, re.IGNORECASE)
    number = float(said[1]) * UNITS[(said[2] or "GB").upper()] if said else 0.0
    if not number > 0:
        raise BadInput(f"{VARIABLE}={text}: has to be a number of GB, or one with a unit, such as 2GB or 500MB")
    return number


MARGIN = 100e6
"""Bytes for blocks of files on their way, and for what the allocator does not give back."""

PARTS = 4.75
"""Networks are given one of so many parts of what is left; clusters take two, and what the inference keeps the rest."""


def share() -> float:
    """Bytes that networks may take for the steps that go through them together."""
    return max(1.0, ((_said() or ORDINARY) - PROGRAM - MARGIN) / PARTS)


def refuse_too_much(needed: float, what: str, remedy: str) -> None:
    """See that so many bytes may be taken.

    :param what: what takes them, the beginning of a sentence.
    :param remedy: what can be done about it.
    :raises DemonstrationsError: they are more than are allowed.
    """
    if needed > allowed():
        more = math.ceil(needed / 1e8) / 10
        raise DemonstrationsError(
            f"{what} takes about {more:g} GB of memory, and {allowed() / 1e9:.4g} are allowed; {remedy}, "
            f"or allow more with {VARIABLE}={more:g}GB"
        )
