"""What each dimension of the control does in demonstrations: constant, a switch, at an extreme, at one value inside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

OFTEN = 0.01
"""A dimension is said to sit on an extreme where it does so in more than this share of the steps."""

ATOM = 0.05
"""A dimension is said to rest on a value inside its range where it is exactly there in this share of the steps."""

FEWEST = 3
"""Steps in which a value is taken often, at least: numbers that were rounded are equal now and then."""

TOGETHER = 0.9
"""Two dimensions are said to rest at once where this share of the steps in which either does is the same steps."""


@dataclass(frozen=True)
class ControlDimension:
    """One dimension of the control over all steps of some demonstrations.

    :param number: which one, from 0.
    :param minimum: the smallest value, in the control's own units; ``maximum`` likewise.
    :param at_minimum: the number of steps exactly there; ``at_maximum`` likewise.
    :param steps: the number of all steps.
    :param distinct: its values in order, where they are at most :data:`MOST_DISTINCT`; else empty.
    :param inside: the commonest of the values between its extremes; None where it takes none of them often.
    :param at_inside: the number of steps exactly there.
    :param together: the other dimensions that are at their ``inside`` in the same steps (:data:`TOGETHER`).
    :param integer: whether it is of an integer type.
    """

    number: int
    minimum: float
    maximum: float
    at_minimum: int
    at_maximum: int
    steps: int
    distinct: tuple[float, ...] = ()
    inside: float | None = None
    at_inside: int = 0
    together: tuple[int, ...] = ()
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
    def atom(self) -> str:
        """Where it rests on a value inside its range, and how often, in words; empty where it does not."""
        if self.inside is None or self.discrete or self.at_inside < max(FEWEST, ATOM * self.steps):
            return ""
        return f"exactly {number(self.inside)} in {100 * self.at_inside / self.steps:.1f} % of the steps"

    @property
    def note(self) -> str:
        """What is odd about it, in a few words; empty where nothing is."""
        if self.constant:
            return f"constant ({number(self.minimum)}): no part of the model, emitted as it is"
        if self.values:
            return f"takes two values, {number(self.minimum)} and {number(self.maximum)}"
        ends = ", at its ".join(
            f"{name} {number(value)} in {100 * share:.1f} % of the steps" for name, value, share in self.extremes
        )
        return "; ".join(filter(None, (self.atom, ends and f"exactly at its {ends}")))

    def as_data(self) -> dict[str, Any]:
        """The same as plain data, without its type, its distinct values and the other dimensions."""
        left_out = ("distinct", "together", "integer")
        return {key: value for key, value in asdict(self).items() if key not in left_out}


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


NOWHERE: tuple[float | None, int, tuple[int, ...]] = (None, 0, ())
"""What is said of a dimension that takes no value inside its range often."""


class ControlStatistics:
    """Gathers, block by block, what is asked of each dimension of a control of any shape; only finite values count."""

    def __init__(self) -> None:
        self._columns: list[np.ndarray] = []  # minimum, maximum, steps there, steps: each [A]
        self._distinct: list[np.ndarray] = []
        self._often = _Often()
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
        self._often.add(values)

    def dimensions(self) -> tuple[ControlDimension, ...]:
        """What was gathered; a dimension without any finite value is left out."""
        columns = [column.tolist() for column in self._columns]
        few = [tuple(values.tolist()) if len(values) <= MOST_DISTINCT else () for values in self._distinct]
        inside = self._often.inside(*self._columns[:2]) if columns else {}
        return tuple(
            ControlDimension(
                index, low, high, at_low, at_high, steps, distinct, *inside.get(index, NOWHERE), integer=self._integer
            )
            for index, (low, high, at_low, at_high, steps, distinct) in enumerate(zip(*columns, few, strict=True))
            if steps
        )


CHUNK = 4096
"""Steps that are looked at together for values that are taken often."""

KEPT = 3
"""Values of a dimension that are counted from chunk to chunk: the commonest may be both extremes and one between."""

MOST_DIMENSIONS = 256
"""Of a larger control no values are counted: it is no robot's."""


class _Often:
    """The commonest values of each dimension, and in how many steps each two of them are taken at once.

    A value counts from the chunk on in which it is taken in a share :data:`ATOM` of the steps. So the counts of up to
    :data:`CHUNK` steps are exact, and of more those of every value that is as common in the first of them.
    """

    def __init__(self) -> None:
        self._waiting: list[np.ndarray] = []
        self._values: list[tuple[int, float]] = []
        self._counts = np.zeros((0, 0))

    def add(self, controls: np.ndarray) -> None:
        """Take in some steps [T, A]."""
        if controls.shape[1] <= MOST_DIMENSIONS:
            self._waiting.append(controls)
        if sum(map(len, self._waiting)) >= CHUNK:
            rows = np.concatenate(self._waiting)
            whole = len(rows) // CHUNK * CHUNK
            for chunk in np.split(rows[:whole], whole // CHUNK):
                self._count(chunk)
            self._waiting = [rows[whole:]]

    def inside(self, low: np.ndarray, high: np.ndarray) -> dict[int, tuple[float, int, tuple[int, ...]]]:
        """The commonest value of each dimension between its extremes, how often it is taken, and the other dimensions
        that are at theirs in the same steps.
        """
        if waiting := [rows for rows in self._waiting if len(rows)]:
            self._count(np.concatenate(waiting))
            self._waiting = []
        places: dict[int, int] = {}
        for place, (dimension, value) in enumerate(self._values):  # the commonest come first
            if low[dimension] < value < high[dimension]:
                places.setdefault(dimension, place)
        return {
            dimension: (
                self._values[place][1],
                int(self._counts[place, place]),
                tuple(other for other, at in sorted(places.items()) if at != place and self._at_once(place, at)),
            )
            for dimension, place in places.items()
        }

    def _at_once(self, first: int, second: int) -> bool:
        both = self._counts[first, second]
        either = self._counts[first, first] + self._counts[second, second] - both
        return bool(both >= TOGETHER * either)

    def _count(self, rows: np.ndarray) -> None:
        for dimension, column in enumerate(rows.T):
            values, times = np.unique(column[np.isfinite(column)], return_counts=True)
            often = np.argsort(-times, kind="stable")[:KEPT]
            often = often[times[often] >= max(FEWEST, ATOM * len(rows))]
            found = ((dimension, value + 0.0) for value in values[often].tolist())  # + 0.0: minus zero is zero
            self._values += [each for each in found if each not in self._values]
        at = np.zeros((len(rows), len(self._values)), np.float32)
        for place, (dimension, value) in enumerate(self._values):
            at[:, place] = rows[:, dimension] == value
        counts = (at.T @ at).astype(np.float64)
        counts[: len(self._counts), : len(self._counts)] += self._counts
        order = np.argsort(-counts.diagonal(), kind="stable").tolist()
        owners = [self._values[place][0] for place in order]
        kept = [place for rank, place in enumerate(order) if owners[:rank].count(owners[rank]) < KEPT]
        self._values = [self._values[place] for place in kept]
        self._counts = counts[np.ix_(kept, kept)]


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
