"""What each dimension of the control does in demonstrations: constant, a switch between two values, at an extreme."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

OFTEN = 0.01
"""A dimension is said to sit on an extreme where it does so in more than this share of the steps."""


@dataclass(frozen=True)
class ControlDimension:
    """One dimension of the control over all steps of some demonstrations.

    :param number: which one, from 0.
    :param minimum: the smallest value, in the control's own units; ``maximum`` likewise.
    :param at_minimum: the number of steps exactly there; ``at_maximum`` likewise.
    :param steps: the number of all steps.
    :param distinct: its values in order, where they are at most :data:`MOST_DISTINCT`; else empty.
    :param integer: whether it is of an integer type.
    """

    number: int
    minimum: float
    maximum: float
    at_minimum: int
    at_maximum: int
    steps: int
    distinct: tuple[float, ...] = ()
    integer: bool = False

    @property
    def whole(self) -> bool:
        """Whether it takes few values, and whole numbers from 0 on."""
        return bool(self.distinct) and self.minimum >= 0 and all(value.is_integer() for value in self.distinct)

    @property
    def discrete(self) -> bool:
        """Whether it is of an integer type and takes few values."""
        return self.integer and bool(self.distinct)

    @property
    def constant(self) -> bool:
        """Whether it has the same value in every step."""
        return self.minimum == self.maximum

    @property
    def values(self) -> tuple[float, ...]:
        """Its values where it takes one or two; empty where it takes more."""
        if self.constant:
            return (self.minimum,)
        return (self.minimum, self.maximum) if self.at_minimum + self.at_maximum == self.steps else ()

    @property
    def extremes(self) -> tuple[tuple[str, float, float], ...]:
        """(``minimum`` or ``maximum``, its value, share of the steps exactly there) where it often sits on it.

        Empty where it takes one or two values only, or is discrete. A value that it takes once does not count: every
        extreme is taken once.
        """
        ends = (("minimum", self.minimum, self.at_minimum), ("maximum", self.maximum, self.at_maximum))
        often = [(name, value, at / self.steps) for name, value, at in ends if at > max(1, OFTEN * self.steps)]
        return () if self.values or self.discrete else tuple(often)

    @property
    def note(self) -> str:
        """What is odd about it, in a few words; empty where nothing is."""
        if self.constant:
            return f"constant ({number(self.minimum)}): no part of the model, emitted as it is"
        if self.values:
            return f"takes two values, {number(self.minimum)} and {number(self.maximum)}"
        if self.extremes:
            return "exactly at its " + ", at its ".join(
                f"{name} {number(value)} in {100 * share:.1f} % of the steps" for name, value, share in self.extremes
            )
        return ""

    def as_data(self) -> dict[str, Any]:
        """The same as plain data, without its type and distinct values."""
        return {key: value for key, value in asdict(self).items() if key not in ("distinct", "integer")}


def number(value: float) -> str:
    """A value with as few digits as tell it from any other of its type, single or double; never as minus zero."""
    value = float(value) + 0.0
    if value.is_integer() and abs(value) < 1e16:
        return str(int(value))
    with np.errstate(over="ignore"):
        single = np.float32(value)
    return str(single) if float(single) == value else str(value)


MOST_DISTINCT = 64
"""Distinct values of a dimension that are kept."""


class ControlStatistics:
    """Gathers, block by block, what is asked of each dimension of a control of any shape; only finite values count."""

    def __init__(self) -> None:
        self._columns: list[np.ndarray] = []  # minimum, maximum, steps there, steps: each [A]
        self._distinct: list[np.ndarray] = []
        self._integer = True

    def add(self, controls: np.ndarray) -> None:
        """Take in some steps [T, A]."""
        self._integer &= controls.dtype.kind in "iu"
        values = np.asarray(controls, dtype=np.float64).reshape(len(controls), -1)
        finite = np.isfinite(values)
        if not len(values):
            return
        low, high = np.where(finite, values, np.inf).min(0), np.where(finite, values, -np.inf).max(0)
        new = [low, high, (values == low).sum(0), (values == high).sum(0), finite.sum(0)]
        self._columns = _merged(self._columns, new) if self._columns else new
        before = self._distinct or [np.empty(0)] * values.shape[1]
        self._distinct = [
            _distinct(old, column[use]) for old, column, use in zip(before, values.T, finite.T, strict=True)
        ]

    def dimensions(self) -> tuple[ControlDimension, ...]:
        """What was gathered; a dimension without any finite value is left out."""
        columns = [column.tolist() for column in self._columns]
        few = [tuple(values.tolist()) if len(values) <= MOST_DISTINCT else () for values in self._distinct]
        return tuple(
            ControlDimension(index, low, high, at_low, at_high, steps, distinct, self._integer)
            for index, (low, high, at_low, at_high, steps, distinct) in enumerate(zip(*columns, few, strict=True))
            if steps
        )


def _distinct(before: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The distinct values so far, in order; of too many just enough to know that they are."""
    return before if len(before) > MOST_DISTINCT else np.union1d(before, values)[: MOST_DISTINCT + 1]


def _merged(before: Sequence[np.ndarray], new: Sequence[np.ndarray]) -> list[np.ndarray]:
    low, high = np.minimum(before[0], new[0]), np.maximum(before[1], new[1])
    at_low, at_high = (
        sum(np.where(part[end] == value, part[end + 2], 0) for part in (before, new))
        for end, value in ((0, low), (1, high))
    )
    return [low, high, np.asarray(at_low), np.asarray(at_high), before[4] + new[4]]


def all_constant(dimensions: Sequence[ControlDimension]) -> str:
    """What is wrong where no dimension varies."""
    values = ", ".join(number(dimension.minimum) for dimension in dimensions[:5]) + ", ..." * (len(dimensions) > 5)
    return f"actions: every dimension is constant ({values}) in all demonstrations, so there is no control to model"


def notes(dimensions: Iterable[ControlDimension]) -> list[str]:
    """A line for each dimension that is odd in some way."""
    return [f"control dimension {dimension.number}: {dimension.note}" for dimension in dimensions if dimension.note]


def control_dimensions(controls: Iterable[np.ndarray]) -> tuple[ControlDimension, ...]:
    """What each control dimension does in these blocks of steps [T, A]."""
    statistics = ControlStatistics()
    for block in controls:
        statistics.add(block)
    return statistics.dimensions()
