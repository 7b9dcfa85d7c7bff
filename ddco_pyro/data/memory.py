"""Whether demonstrations fit into memory, by their shapes: said before they are read."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.errors import BadInput

VARIABLE = "DDCO_PYRO_MEMORY"
ALLOWED = 2.0
"""GB that may be taken where ``$DDCO_PYRO_MEMORY`` says nothing else."""

PROGRAM = 620e6
"""Bytes that a fit of next to nothing takes: mostly torch, Pyro and compiled code."""

COPIES = 20.0
"""Bytes that a fit takes for a feature or control of a padded step, beside the demonstrations: 2 float64, 1 float32."""

PICTURES = 2.0
"""Copies of the pictures that a fit takes, beside the demonstrations."""

INFERENCE = 5e3
"""Bytes that networks and inference take for a step of the longest demonstration, which is never divided."""


class Array(Protocol):
    """An array that need not be in memory."""

    @property
    def shape(self) -> tuple[int, ...]:
        """[T, ...]."""

    @property
    def dtype(self) -> np.dtype:
        """What it holds."""


@dataclass(frozen=True)
class Extent:
    """How much there is of demonstrations, by their headers.

    :param lengths: steps of each.
    :param size: bytes of all that is read, as it is in memory.
    :param numbers: by place (``actions``, ``obs/<key>``) the numbers at each step.
    :param pictures: the same for pictures, bytes.
    """

    lengths: tuple[int, ...]
    size: int
    numbers: Mapping[str, int]
    pictures: Mapping[str, int]

    @classmethod
    def of(cls, demonstrations: Iterable[Mapping[str, Array]]) -> Extent:
        """Of arrays by place for each demonstration; labels count where they are read only."""
        lengths, size = [], 0
        numbers: dict[str, int] = {}
        pictures: dict[str, int] = {}
        for arrays in demonstrations:
            lengths.append(arrays["actions"].shape[0] if arrays["actions"].shape else 0)
            for place, one in arrays.items():
                plain = one.dtype == np.uint8
                size += math.prod(one.shape) * (1 if plain else 8)
                kind = pictures if plain and len(one.shape) == 4 else numbers
                if not place.startswith("labels/"):
                    kind[place] = max(kind.get(place, 0), math.prod(one.shape[1:]))
        return cls(tuple(lengths), size, numbers, pictures)

    def step(self, differences: Collection[str] = ()) -> float:
        """Bytes that networks are given for a step, and what is made on the way there.

        :param differences: places of observations whose differences are appended.
        """
        features = sum(one * (2 if place in differences else 1) for place, one in self.numbers.items())
        return COPIES * features + PICTURES * sum(self.pictures.values())

    def fit(self, differences: Collection[str] = ()) -> float:
        """Bytes that a fit takes, about; measured with up to 200 observations of 100,000 steps."""
        longest = max(self.lengths)
        padded = len(self.lengths) * longest
        return PROGRAM + self.size + padded * self.step(differences) + INFERENCE * longest


def allowed() -> float:
    """Bytes that may be taken.

    :raises BadInput: ``$DDCO_PYRO_MEMORY`` is not a positive number.
    """
    text = os.environ.get(VARIABLE, str(ALLOWED))
    try:
        found = float(text)
    except ValueError:
        found = math.nan
    if not found > 0:
        raise BadInput(f"{VARIABLE}={text}: has to be a positive number of GB")
    return 1e9 * found


def refuse_too_much(needed: float, what: str, remedy: str) -> None:
    """See that so many bytes may be taken.

    :param what: what takes them, the beginning of a sentence.
    :param remedy: what can be done about it.
    :raises DemonstrationsError: they are more than are allowed.
    """
    if needed > allowed():
        more = math.ceil(needed / 1e8) / 10
        raise DemonstrationsError(
            f"{what} takes about {more:g} GB of memory, and {allowed() / 1e9:g} are allowed; {remedy}, "
            f"or allow more with {VARIABLE}={more:g}"
        )
