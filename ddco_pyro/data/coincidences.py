"""What coincides in demonstrations: copies, what is no observation, and angles that are one after a turn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ddco_pyro.data.controls import listed
from ddco_pyro.data.demonstrations import split_by_masks
from ddco_pyro.data.errors import DemonstrationsError

# --- copies -------------------------------------------------------------------------------------------------


def copies(digests: Mapping[str, bytes], masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """A line for demonstrations that equal another one in all arrays but labels, where a split may part them.

    :param digests: of the places and values of its arrays, by the name of each demonstration.
    """
    known: dict[bytes, str] = {}
    pairs = [(known.setdefault(digest, name), name) for name, digest in digests.items()]
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


# --- what is no observation ---------------------------------------------------------------------------------

LOOKED_AT = 1000
"""Steps of each demonstration in which observations are compared with controls."""

SHIFTS = {0: ("at the same step", 1e-3), 1: ("of the next step", 1e-3), -1: ("of the step before", 1e-6)}
"""Steps by which a control follows the observation that tells it, and the largest share of the observation's
variance, 1 - R², that the control leaves unexplained."""

FEWEST = 10
"""Fewest pairs of steps that tell anything."""

EXACT = 1e-9
"""What is unexplained by rounding alone."""

LATER = 0.1
"""An observation that follows the control of the step before is a state that the control moved. A copy of a
later control leaves less than this part of what that one leaves."""

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
"""A target is this near to what it targets: the root mean square of their difference, in deviations of it."""


@dataclass(frozen=True)
class Beside:
    """An observation beside the controls of the same demonstrations, and what it tells of them.

    :param seen: the observation in each demonstration [T, D].
    :param controls: their controls [T, A].
    :param varying: the control dimensions that vary.
    :param still: the constant dimensions of the observation.
    """

    place: str
    seen: Sequence[np.ndarray]
    controls: Sequence[np.ndarray]
    varying: Sequence[int]
    still: Sequence[int]

    def at(self, shift: int) -> tuple[np.ndarray, np.ndarray]:
        """The observation [N, D] of steps with a control so many steps later, and these controls [N, A]."""
        pairs = zip(self.seen, self.controls, strict=True)
        whole = [(rows[:LOOKED_AT], commands[:LOOKED_AT]) for rows, commands in pairs]
        spans = [slice(max(-shift, 0), max(len(rows) - max(shift, 0), 0)) for rows, _ in whole]
        seen = [rows[span] for (rows, _), span in zip(whole, spans, strict=True)]
        told = [rows[max(shift, 0) :][: len(own)] for (_, rows), own in zip(whole, seen, strict=True)]
        return np.concatenate(seen).astype(np.float64), np.concatenate(told).astype(np.float64)

    @cached_property
    def told(self) -> dict[int, tuple[list[int], list[int]]]:
        """By shift, the numbers of the observation that tell controls, and these controls."""
        found = []
        for shift in SHIFTS:
            seen, controls = self.at(shift)
            rest = np.ones((seen.shape[1], controls.shape[1]))  # 1 - R² of each number by each control
            if len(seen) >= FEWEST:
                with np.errstate(all="ignore"):
                    seen, controls = seen - seen.mean(0), controls - controls.mean(0)
                    squares = np.outer(np.square(seen).sum(0), np.square(controls).sum(0))
                    rest -= np.nan_to_num((seen.T @ controls) ** 2 / squares, posinf=0)
            found.append(rest[:, list(self.varying)])
        rest = np.maximum(found, EXACT)
        best, least = rest.argmin(0), rest.min(0)
        told = least <= np.array([limit for _, limit in SHIFTS.values()])[best]
        told &= (least <= LATER * rest[-1]) | (least == EXACT) | (best == len(SHIFTS) - 1)
        each = ((shift, told & (best == place)) for place, shift in enumerate(SHIFTS))
        return {
            shift: (np.flatnonzero(which.any(1)).tolist(), np.array(self.varying)[which.any(0)].tolist())
            for shift, which in each
            if which.any()
        }

    @property
    def followed(self) -> bool:
        """Whether the control is a target of the observation: each number near it at this or the next step.

        The observation has as many numbers, and their difference at a step varies where the control does.
        """
        (seen, controls), (now, then) = self.at(0), self.at(-1)
        if seen.shape[1] != controls.shape[1] or len(now) < FEWEST:
            return False
        with np.errstate(all="ignore"):
            spread = controls.var(0)
            near = [
                (np.square(target - rows).mean(0) <= NEAR**2 * target.var(0))[list(self.varying)].all()
                for rows, target in ((seen, controls), (now, then))
            ]
            moves = (controls - seen).var(0) > EXACT * spread.max()
        return any(near) and bool((moves == np.isin(np.arange(len(spread)), self.varying)).all())

    @property
    def clock(self) -> bool:
        """Whether the observation is one number that rises as a clock does; one called so may step back."""
        if self.seen[0].shape[1] != 1:
            return False
        steps = [np.diff(rows[:LOOKED_AT, 0].astype(np.float64)) for rows in self.seen if len(rows) > 2]
        if not steps or not all(each.any() for each in steps):
            return False
        if self.place.rpartition("/")[2] in CLOCKS:
            return all(np.median(each) >= 0 for each in steps)
        return all(each.min() >= 0 and np.ptp(each) <= EVEN * np.median(each) for each in steps)

    @property
    def reason(self) -> str:
        """Why this is no observation, in words; empty where a policy may read it."""
        if self.clock:
            return "is a clock, which reads other values on another day; the built-in step counts from 0"
        rest = set(range(self.seen[0].shape[1])) - set(self.still)
        found = {shift: each for shift, each in self.told.items() if shift >= 0}
        if not rest or not rest <= {number for observed, _ in found.values() for number in observed}:
            return ""
        controls = [f"control {listed(told)} {SHIFTS[shift][0]}" for shift, (_, told) in found.items()]
        return f"is {' and '.join(controls)}, up to units and noise, which a policy has to predict"

    def notes(self) -> Iterator[str]:
        """A line for each shift: where the observation holds controls among others, or the one before."""
        for shift, (observed, controls) in self.told.items():
            effect = "tend to repeat it" if shift < 0 else "see what they have to predict"
            what = f"{self.place}: {listed(observed)} = control {listed(controls)} {SHIFTS[shift][0]}"
            yield f"{what}, up to units and noise: policies {effect}"


def generated(place: str) -> str:
    """Why an array is no observation by its name, in words; empty where a policy may read it."""
    return next((why for part, why in GENERATED.items() if part in place.split("/")), "")


# --- angles and quaternions ---------------------------------------------------------------------------------

TURNS = {"2π": 2 * math.pi, "360": 360.0}
"""A turn in radians and in degrees, and what it is called."""

NEARLY = 0.85
"""A change of an angle by this part of a turn is a jump by a turn."""

UNIT = 0.02
"""The squared length of a unit quaternion is within this distance of 1."""


@dataclass(frozen=True)
class Jumps:
    """The numbers of an array that jump from step to step.

    :param angles: by the name of a turn, numbers that jump by it.
    :param quaternions: the first number of each unit quaternion that flips its sign.
    :param first: a demonstration in which one does.
    """

    angles: Mapping[str, Sequence[int]]
    quaternions: Sequence[int]
    first: str

    def notes(self, place: str) -> Iterator[str]:
        """A line for angles of an array that jump by a turn, and for quaternions that change their sign."""
        where, seen = f"the first in {self.first}", place != "actions"
        for unit, numbers in self.angles.items():
            setting = f"with angles: {numbers} beside its key networks read sine and cosine"
            remedy = setting if seen else "unwrap it"
            if seen and unit != "2π":
                remedy = f"store radians; {remedy}"
            if numbers:
                jump = f"jump{'s' * (len(numbers) == 1)} by {unit} as an angle"
                yield f"{place}: {listed(numbers)} {jump}, {where}: {remedy}"
        if numbers := self.quaternions:
            parts = listed([first + part for first in numbers for part in range(4)])
            setting = f"with quaternions: {numbers} beside its key"
            setting += " networks read products, the same for q and −q"
            remedy = setting if seen else "give all rotations one sign"
            yield f"{place}: {parts} change sign as a quaternion, {where}: {remedy}"


def jumps(each: Mapping[str, np.ndarray]) -> Jumps | None:
    """The jumps of an array [T, D] of demonstrations by name; None without any.

    An angle lies within a turn, and jumps by a turn but not by a part of one. A quaternion may begin with
    another sign than in the first demonstration.
    """
    rows = np.concatenate([*each.values()]).astype(np.float64)
    starts = np.cumsum([0, *map(len, each.values())])[:-1]
    before = np.concatenate([rows[:1], rows[:-1]])
    before[starts] = rows[0]
    with np.errstate(invalid="ignore", over="ignore"):
        changes, spread = np.abs(rows - before), np.ptp(rows, axis=0)
        changes[starts] = 0
        flips = _fours(rows * before) < -NEARLY
        flips &= (np.abs(_fours(rows * rows) - 1) < UNIT).all(0)
        quaternions: list[int] = []
        for place in np.flatnonzero(flips.any(0)).tolist():
            quaternions += [place] if not quaternions or place >= quaternions[-1] + 4 else []
        parts = [first + part for first in quaternions for part in range(4)]
        free = ~np.isin(np.arange(rows.shape[1]), parts)
        angles, jumped = {}, flips.any(1)
        for unit, turn in TURNS.items():
            by_turn = changes > NEARLY * turn
            partly = ((changes > turn / 4) & ~by_turn).sum(0)
            wraps = free & by_turn.any(0) & (10 * partly <= by_turn.sum(0))
            wraps &= (spread >= NEARLY * turn) & (spread <= 1.02 * turn)
            angles[unit] = np.flatnonzero(wraps).tolist()
            jumped |= by_turn[:, wraps].any(1)
    if not jumped.any():
        return None
    return Jumps(angles, quaternions, [*each][np.searchsorted(starts, jumped.argmax(), "right") - 1])


def _fours(products: np.ndarray) -> np.ndarray:
    """Sums [T, D - 3] of each four neighbouring numbers [T, D]; none of fewer."""
    if products.shape[1] < 4:
        return np.zeros((len(products), 0))
    sums: np.ndarray = np.lib.stride_tricks.sliding_window_view(products, 4, axis=1).sum(-1)
    return sums
