"""How the joint choices of a hierarchy are numbered, and where each table has its columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ddco_pyro.model.tables import Tables

NOBODY = -1
"""The actor of a joint choice that cannot be: something other than choice 0 below a choice 0."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Index tables for D levels, lowest first. C_d = 1 + k_d counts a level's choices, control among them.

    A joint choice is one index, h^D the slowest digit and h^1 the fastest. A *message* of level d runs over
    (h^D, ..., h^d); the messages of levels 1 to D + 1 stand one after the other, that of level D + 1 being the single
    number of everything terminated. A step's tables are flat rows with each level after the other.

    :param sizes: C_d, [D].
    :param starts: first index of each level's message, [D + 1].
    :param selects: first column of each level in a row of selections, each level [callers, C_d], [D].
    :param ends: first column of each level in a row of terminations, each level [k_d, 2], [D].
    :param actors: the column of who acts in a row of controls (each level's k_d options, then the meta-policy), or
        ``NOBODY``, for every joint choice, [S].
    :param choices: the column of each level's choice in a row of marginals, each level [C_d], for every joint choice,
        [S, D].
    """

    sizes: tuple[int, ...]
    starts: tuple[int, ...]
    selects: tuple[int, ...]
    ends: tuple[int, ...]
    actors: np.ndarray
    choices: np.ndarray

    @property
    def joint(self) -> int:
        """The number S of joint choices."""
        return len(self.actors)

    def digits(self, joint: np.ndarray) -> tuple[np.ndarray, ...]:
        """The choice of each level, lowest first, in joint choices of any shape."""
        choices = []
        for size in self.sizes:
            choices.append(joint % size)
            joint = joint // size
        return tuple(choices)


def structure_of(tables: Tables) -> Structure:
    """The structure of these tables."""
    return structure(tuple(table.shape[-1] for table in tables.selection))


@lru_cache
def structure(sizes: tuple[int, ...]) -> Structure:
    """The structure of levels with so many choices, control among them."""
    depth = len(sizes)
    callers = [*(size - 1 for size in sizes[1:]), 1][:depth]
    messages = [int(np.prod(sizes[level:])) for level in range(depth)]
    digits = np.indices(sizes[::-1]).reshape(depth, -1)[::-1]  # [D, S], lowest level first
    controls = _offsets([size - 1 for size in sizes])
    return Structure(
        sizes=sizes,
        starts=_starts(messages),
        selects=_offsets([caller * size for caller, size in zip(callers, sizes, strict=True)]),
        ends=_offsets([2 * (size - 1) for size in sizes]),
        actors=np.array([_actor(choice, controls, sum(sizes) - depth) for choice in digits.T], dtype=np.int64),
        choices=(digits.T + np.array(_offsets(sizes), dtype=np.int64)).astype(np.int64),
    )


def _actor(choice: np.ndarray, controls: Sequence[int], meta_policy: int) -> int:
    """The lowest level with a choice other than 0 acts; all below it must be 0, and nothing above it may be."""
    acting = np.flatnonzero(choice)
    if not len(acting):
        return meta_policy
    lowest = acting[0]
    return int(controls[lowest] + choice[lowest] - 1) if choice[lowest:].all() else NOBODY


def _starts(sizes: Sequence[int]) -> tuple[int, ...]:
    """Where each of consecutive parts begins, and where the last one ends."""
    return tuple(int(start) for start in np.cumsum([0, *sizes]))


def _offsets(sizes: Sequence[int]) -> tuple[int, ...]:
    return _starts(sizes)[:-1]
