"""What coincides in demonstrations: copies, what is no observation, and angles that are one after a turn."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.data.controls import few, listed
from ddco_pyro.data.division import split_by_masks
from ddco_pyro.data.errors import DemonstrationsError

# --- copies -----------------------------------------------------------------------------------------------------------


def copies(digests: Mapping[str, Any], masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A line for demonstrations that equal another one in all arrays but labels, where a split may part them.

    :param digests: of the places and values of its arrays, by the name of each demonstration.
    """
    known: dict[bytes, str] = {}
    pairs = [(known.setdefault(digest.digest(), name), name) for name, digest in digests.items()]
    pairs = [(first, again) for first, again in pairs if first != again]
    effect = "one of two that are the same may be trained on and the other held out"
    if masks.keys() & {"train", "valid"}:
        try:
            valid = set(split_by_masks(list(digests), masks)[1])
        except DemonstrationsError:
            return  # reported as a problem
        pairs = [pair for pair in pairs if len({*pair} & valid) == 1]
        effect = "one of them is trained on and the other held out"
    if pairs:
        first, again = pairs[0]
        those = f"{len(pairs)} of {len(digests)} demonstrations equal another one"
        yield f"{those}, the first {again}, which equals {first}: {effect}"


# --- what is no observation -------------------------------------------------------------------------------------------

LOOKED_AT = 1000
"""Steps of each demonstration in which observations are compared with controls."""

SHIFTS = {0: ("at the same step", 1e-3), 1: ("of the next step", 1e-3), -1: ("of the step before", 1e-6)}
"""Steps by which a control follows the observation that tells it, and the largest share of the observation's variance,
1 - R², that the control leaves unexplained."""

FEWEST = 10
"""Fewest pairs of steps that tell anything."""

EXACT = 1e-9
"""What is unexplained by rounding alone."""

LATER = 0.1
"""An observation that follows the control of the step before is a state that the control moved. A copy of a later
control leaves less than this part of what that one leaves."""

CLOCKS = {"timestamp", "timestamps", "time", "clock"}
"""Keys of observations that are clocks where they rise, however unevenly."""

EVEN = 0.1
"""Other scalars are clocks where they rise by steps that differ by at most this part of one."""

GENERATED = {
    "subtask_term_signals": "is a label, labels/subtask, and no observation",
    "datagen_info": "is what a generator of data plans, and no robot sees it",
    "target_eef_pose": "is the target of a controller, the answer that a policy has to give",
}
"""Parts of keys that MimicGen and Isaac Lab give to what is no observation, and why."""


NEAR = 0.25
"""A target is this near to what it is a target of: the root mean square of their difference, in deviations of it."""


class Leaks:
    """Observations that no policy should read: controls in any units, clocks, and what a generator of data writes."""

    def __init__(self) -> None:
        self._origin: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # subtracted from both, against cancellation
        self._products: dict[tuple[str, int], np.ndarray] = {}
        self._clocks: dict[str, bool] = {}

    def add(self, place: str, rows: np.ndarray, commands: np.ndarray) -> None:
        """Compare an observation [T, D] of a demonstration with its controls [T, A]."""
        rows, commands = rows[:LOOKED_AT].astype(np.float64), commands[:LOOKED_AT].astype(np.float64)
        if len(rows) > 2:
            self._clocks[place] = self._clocks.get(place, True) and _rises(place, rows)
        origin = self._origin.setdefault(place, (rows[:1], commands[:1]))
        for shift in SHIFTS:
            seen = rows[max(-shift, 0) : max(len(rows) - max(shift, 0), 0)]
            told = commands[max(shift, 0) :][: len(seen)]
            both = np.column_stack([np.ones(len(seen)), seen - origin[0], told - origin[1]])
            with np.errstate(over="ignore", invalid="ignore"):
                self._products[place, shift] = self._products.get((place, shift), 0) + both.T @ both

    def _moments(self, place: str, shift: int) -> tuple[float, np.ndarray, np.ndarray]:
        """The number of steps, the sums and the centred products of an observation and the controls behind it."""
        products = self._products[place, shift]
        count, sums = max(products[0, 0], 1.0), products[0, 1:]
        return count, sums, products[1:, 1:] - np.outer(sums, sums) / count

    def _unexplained(self, place: str) -> np.ndarray:
        """1 - R² of each number of an observation by each control at each of :data:`SHIFTS`, [3, D, A]."""
        found, size = [], self._origin[place][0].shape[1]
        for shift in SHIFTS:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                count, _, products = self._moments(place, shift)
                squares = products.diagonal()
                rest = 1 - products[:size, size:] ** 2 / np.outer(squares[:size], squares[size:])
            found.append(np.where(np.isfinite(rest) & (count >= FEWEST), rest, 1.0))
        return np.maximum(found, EXACT)

    def _found(self, place: str, varying: Sequence[int]) -> dict[int, tuple[list[int], list[int]]]:
        """By shift, the numbers of an observation that tell controls, and these controls."""
        rest = self._unexplained(place)[:, :, list(varying)]
        best, least = rest.argmin(0), rest.min(0)
        told = least <= np.array([limit for _, limit in SHIFTS.values()])[best]
        told &= (least <= LATER * rest[-1]) | (least == EXACT) | (best == len(SHIFTS) - 1)
        each = ((shift, told & (best == place)) for place, shift in enumerate(SHIFTS))
        return {
            shift: (np.flatnonzero(which.any(1)).tolist(), np.array(varying)[which.any(0)].tolist())
            for shift, which in each
            if which.any()
        }

    def followed(self, place: str, varying: Sequence[int]) -> bool:
        """Whether the control is a target of an observation: near to it at this or the next step, number by number.

        The observation has as many numbers, and their difference at the same step varies where the control does.
        """
        if place not in self._origin or len({rows.shape[1] for rows in self._origin[place]}) > 1:
            return False
        near, apart = [], np.subtract(*self._origin[place][::-1])[0]
        each = len(apart)
        for shift in (-1, 0):
            with np.errstate(over="ignore", invalid="ignore"):
                count, sums, products = self._moments(place, shift)
                squares, spread = products.diagonal(), products.diagonal()[each:]
                changes = squares[:each] + spread - 2 * products[:each, each:].diagonal()
                offset = apart + (sums[each:] - sums[:each]) / count
                near.append((changes + count * offset**2 <= NEAR**2 * spread)[varying].all())
        moves = np.isin(np.arange(each), varying)
        return bool(any(near) and ((changes > EXACT * spread.max()) == moves).all())

    def reason(self, place: str, varying: Sequence[int], still: Sequence[int]) -> str:
        """Why an observation is no observation, in words; empty where a policy may read it.

        :param varying: the control dimensions that vary.
        :param still: the constant dimensions of the observation.
        """
        for part, why in GENERATED.items():
            if part in place.split("/"):
                return why
        if self._clocks.get(place):
            return "is a clock, which reads other values on another day; the built-in step counts from 0"
        rest = set(range(len(self._origin[place][0][0]))) - set(still) if place in self._origin else set()
        found = {shift: each for shift, each in self._found(place, varying).items() if shift >= 0} if rest else {}
        if not rest or not rest <= {number for observed, _ in found.values() for number in observed}:
            return ""
        controls = " and ".join(f"control {listed(told)} {SHIFTS[shift][0]}" for shift, (_, told) in found.items())
        return f"is {controls}, up to units and noise, which a policy has to predict"

    def notes(self, varying: Sequence[int], left_out: Collection[str]) -> Iterator[str]:
        """A line for each shift, of observations that hold controls among other numbers, or the one before.

        :param left_out: observations that are not to be read at all.
        """
        for place in (place for place in self._origin if place not in left_out):
            for shift, (observed, controls) in self._found(place, varying).items():
                effect = "tend to repeat it" if shift < 0 else "see what they have to predict"
                what = f"{place}: {listed(observed)} = control {listed(controls)} {SHIFTS[shift][0]}"
                yield f"{what}, up to units and noise: policies {effect}"


def _rises(place: str, rows: np.ndarray) -> bool:
    """Whether an observation [T, D] is one number that rises as a clock does."""
    steps = np.diff(rows[:, :1], axis=0)
    if rows.shape[1] != 1 or not (steps >= 0).all() or not steps.any():
        return False
    return place.rpartition("/")[2] in CLOCKS or bool(np.ptp(steps) <= EVEN * np.median(steps))


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
