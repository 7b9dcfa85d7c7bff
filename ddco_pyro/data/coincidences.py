"""What coincides in demonstrations: copies, controls among observations, and angles that are one after a turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.data.controls import few, listed
from ddco_pyro.data.division import split_by_masks
from ddco_pyro.data.errors import DemonstrationsError

# --- copies -----------------------------------------------------------------------------------------------------------


class Copies:
    """Demonstrations that equal another one in all arrays but labels.

    :ivar digests: of the places and values of its arrays, by the name of each demonstration.
    """

    def __init__(self) -> None:
        self.digests: dict[str, Any] = {}

    def notes(self, masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
        """A line for the copies, of which one may be trained on and the other held out."""
        known: dict[bytes, str] = {}
        each = [(known.setdefault(digest.digest(), name), name) for name, digest in self.digests.items()]
        pairs = [(first, again) for first, again in each if first != again]
        effect = "one of two that are the same may be trained on and the other held out"
        if masks.keys() & {"train", "valid"}:
            try:
                valid = set(split_by_masks(list(self.digests), masks)[1])
            except DemonstrationsError:
                return  # reported as a problem
            pairs = [pair for pair in pairs if (pair[0] in valid) != (pair[1] in valid)]
            effect = "one of them is trained on and the other held out"
        if pairs:
            first, again = pairs[0]
            yield (
                f"{len(pairs)} of {len(self.digests)} demonstrations equal another one, the first {again}, which "
                f"equals {first}: {effect}"
            )


# --- controls among observations --------------------------------------------------------------------------------------

LOOKED_AT = 1000
"""Steps of each demonstration in which observations are compared with controls."""

SHIFTS = {0: "at the same step", 1: "of the next step", -1: "of the step before"}
"""Steps by which a control follows the observation that equals it."""


class Leaks:
    """Numbers of observations that equal controls in all demonstrations.

    :ivar equal: by place and shift, [D, A]: whether they are always equal.
    """

    def __init__(self) -> None:
        self.equal: dict[str, dict[int, np.ndarray]] = {}
        self._compared: set[tuple[str, int]] = set()

    def add(self, place: str, rows: np.ndarray, commands: np.ndarray) -> None:
        """Compare an observation [T, D] of a demonstration with its controls [T, A]."""
        rows = rows[:LOOKED_AT]
        commands = commands[: len(rows)]
        floats = [array.dtype for array in (rows, commands) if array.dtype.kind == "f"]
        coarser = min(floats, key=lambda dtype: dtype.itemsize, default=np.dtype(np.float64))
        with np.errstate(over="ignore"):
            rows, commands = rows.astype(coarser), commands.astype(coarser)
        shape = rows.shape[1], commands.shape[1]
        for shift, equal in self.equal.setdefault(place, {shift: np.ones(shape, bool) for shift in SHIFTS}).items():
            observed = rows[max(-shift, 0) : max(len(rows) - max(shift, 0), 0)]
            ahead = commands[max(shift, 0) :][: len(observed)]
            self._compared |= {(place, shift)} if len(observed) else set()
            for dimension in np.flatnonzero(equal.any(0)):
                equal[:, dimension] &= (observed == ahead[:, [dimension]]).all(0)

    def _found(self, place: str, shift: int, varying: Sequence[int]) -> tuple[list[int], list[int]]:
        """The dimensions of an observation that equal controls ``shift`` steps later, and those control dimensions."""
        if (place, shift) not in self._compared:
            return [], []
        equal = self.equal[place][shift][:, list(varying)]
        observed, controls = np.flatnonzero(equal.any(1)).tolist(), np.flatnonzero(equal.any(0)).tolist()
        return observed, [varying[column] for column in controls]

    def whole(self, place: str, varying: Sequence[int], still: Sequence[int]) -> bool:
        """Whether an observation holds nothing but controls that are still to be predicted.

        :param still: the constant dimensions of the observation.
        """
        if place not in self.equal:
            return False
        rest = set(range(len(self.equal[place][0]))) - set(still)
        return bool(rest) and rest <= {number for shift in (0, 1) for number in self._found(place, shift, varying)[0]}

    def notes(self, varying: Sequence[int], names: Sequence[str]) -> Iterator[str]:
        """A line for each observation and shift, of the varying control dimensions in these demonstrations."""
        for place in self.equal:
            for shift, when in SHIFTS.items():
                observed, controls = self._found(place, shift, varying)
                if observed:
                    effect = "tend to repeat it" if shift < 0 else "see what they have to predict"
                    yield (
                        f"{place}: {listed(observed)} = control {listed(controls)} {when}, in all {len(names)} "
                        f"demonstrations, the first {names[0]}: policies {effect}"
                    )


# --- angles and quaternions -------------------------------------------------------------------------------------------

TURNS = {"2π": 2 * math.pi, "360": 360.0}
"""A turn in radians and in degrees, and what it is called."""

NEARLY = 0.85
"""A change of an angle by this part of a turn is a jump by a turn."""

UNIT = 0.02
"""The squared length of a unit quaternion is within this distance of 1."""


class Jumps:
    """Jumps of single numbers of a vector [D] by a turn, and of quaternions to their negative, from step to step.

    :ivar names: of the demonstrations with any.
    """

    def __init__(self, size: int) -> None:
        four = max(size - 3, 0)
        self.names: list[str] = []
        self._jumps = np.zeros((len(TURNS), size), int)  # steps in which a number changes by nearly a turn
        self._between = self._jumps.copy()  # by a quarter of a turn or more
        self._unit, self._flips = np.ones(four, dtype=bool), np.zeros(four, int)  # of each four numbers
        self._first: np.ndarray | None = None

    def add(self, rows: np.ndarray, name: str) -> None:
        """Add a demonstration [T, D]; it may begin with another sign than the first one."""
        values = rows.astype(np.float64)
        self._first = values[:1] if self._first is None else self._first
        pairs = np.concatenate([self._first, values])
        with np.errstate(invalid="ignore", over="ignore"):
            changes = np.abs(np.diff(values, axis=0))
            jumps, between = (
                np.stack([(changes > share * turn).sum(0) for turn in TURNS.values()]) for share in (NEARLY, 1 / 4)
            )
            flips = self._flips * 0
            if len(flips):
                self._unit &= (np.abs(_fours(values * values) - 1) < UNIT).all(0)
                flips = (_fours(pairs[1:] * pairs[:-1]) < -NEARLY).sum(0)
        self._jumps += jumps
        self._between += between - jumps
        self._flips += flips
        if jumps.any() or (flips > 0)[self._unit].any():
            self.names.append(name)

    @property
    def quaternions(self) -> list[int]:
        """The first number of each unit quaternion that flips its sign."""
        firsts: list[int] = []
        for place in np.flatnonzero(self._unit & (self._flips > 0)).tolist():
            firsts += [place] if not firsts or place >= firsts[-1] + 4 else []
        return firsts

    def angles(self, low: np.ndarray, high: np.ndarray) -> dict[str, list[int]]:
        """Numbers within ``low`` and ``high`` [D] that jump by a turn and never by half of one, by the unit."""
        taken = {first + place for first in self.quaternions for place in range(4)}
        wrapping = {}
        for (unit, turn), jumps, between in zip(TURNS.items(), self._jumps, self._between, strict=True):
            spread = high.astype(np.float64) - low
            wraps = (jumps > 0) & (10 * between <= jumps) & (spread >= NEARLY * turn) & (spread <= 1.02 * turn)
            wrapping[unit] = [place for place in np.flatnonzero(wraps).tolist() if place not in taken]
        return wrapping

    def notes(self, place: str, low: np.ndarray, high: np.ndarray) -> Iterator[str]:
        """A line for the angles of an array that jump by a turn, and for its quaternions that change their sign."""
        where, seen = f"the first in {few(self.names[:1])}", place != "actions"
        for unit, numbers in self.angles(low, high).items():
            remedy = f"with angles: {numbers} beside its key networks read sine and cosine" if seen else "unwrap it"
            if seen and unit != "2π":
                remedy = f"store radians; {remedy}"
            if numbers:
                jump = f"jump{'s' * (len(numbers) == 1)} by {unit} as an angle"
                yield f"{place}: {listed(numbers)} {jump}, {where}: {remedy}"
        if numbers := self.quaternions:
            remedy = f"with quaternions: {numbers} beside its key networks read products, the same for q and −q"
            yield (
                f"{place}: {listed([first + part for first in numbers for part in range(4)])} change sign as a "
                f"quaternion, {where}: {remedy if seen else 'give all rotations one sign'}"
            )


def _fours(products: np.ndarray) -> np.ndarray:
    """Sums [T, D - 3] of each four neighbouring numbers [T, D]."""
    sums: np.ndarray = np.lib.stride_tricks.sliding_window_view(products, 4, axis=1).sum(-1)
    return sums
