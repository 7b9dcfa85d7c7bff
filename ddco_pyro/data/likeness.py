"""What demonstrations have in common, and which are unlike the others of their file, or unlike those of a fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import is_picture
from ddco_pyro.data.coincidences import NEARLY, TURNS
from ddco_pyro.data.controls import MOST_DIMENSIONS, few, listed
from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.tasks import are_several, task_of

LEAST = 4
"""Fewest demonstrations in a file of which one can be unlike the others."""

APART = 10.0
"""Sizes in other units differ by this factor at least, and by more than those of the other demonstrations do.

Degrees are 57 times radians, so demonstrations may differ in size by a factor of 5 beside."""

FACTORS = {1000.0: ("millimetres", "metres"), 100.0: ("centimetres", "metres"), 57.3: ("degrees", "radians")}
"""Factors between units, the unit of the larger numbers, and that of the smaller ones."""

NEAR = 2.0
"""A ratio of sizes is a factor between units if it differs from that by less.

Sizes, spans and mean changes have the same ratio within twice this: a number that moves more has not other units."""

SURE = 0.5
"""A demonstration agrees with the usual correlations of a control if their cosine is above; below −SURE it is reversed.

Reversing changes every sign; where nine in ten demonstrations are sure, none lies between by chance."""

RESTS = 0.4
"""A control is a gripper's if this share of its steps lies within a tenth of its range from the ends.

These are .5 and more of grippers' steps, and at most .32 of others', whose sign depends on where an object is."""

JUMP = 2.0
"""Numbers jump if they change by so many times their usual largest change, and any other change of the demonstration.

Where recordings are joined, a quarter of the moving numbers and two at least do so at once."""

FASTER = 2.0
"""Another rate makes steps longer by this factor at least, and demonstrations shorter by about as much."""

SAMPLED = 200
"""Steps of each demonstration, about, by which a control's range is judged."""

EXCLUDE = "; exclude such ones (demonstrations.exclude)"
"""The remedy where a fit is to be made."""


@dataclass(frozen=True)
class Usual:
    """What the demonstrations of a fit have in common.

    :param statistics: by place, the lowest, the median and the highest of each statistic of a number [3, 5, D].
    :param correlations: of each control dimension with observations and time [A, F].
    :param agreement: the cosine with these that nine in ten demonstrations exceed [A].
    :param length: the median number of steps.
    :param frequency: control steps per second, Hz; None if unknown.
    :param unlike: why demonstrations are unlike the others, by name.
    """

    statistics: dict[str, list[list[list[float]]]]
    correlations: list[list[float]]
    agreement: list[float]
    length: float
    frequency: float | None
    unlike: dict[str, str]


class Likeness:
    """Statistics of each number of demonstrations, which are added array by array, controls first."""

    def __init__(self) -> None:
        self._lengths: dict[str, int] = {}
        self._tasks: dict[str, str] = {}
        self._controls = np.zeros((0, 0))  # of the demonstration whose arrays are added
        self._sampled: dict[str, np.ndarray] = {}
        self._statistics: dict[str, dict[str, np.ndarray]] = {}
        self._correlations: dict[str, dict[str, np.ndarray]] = {}

    def add(self, name: str, place: str, rows: np.ndarray, task: str = "") -> None:
        """Add an array [T, D] of a demonstration of a task, unless it is too wide.

        The statistics of a number are its size, its span, its mean and its largest change in a step, and the step of
        the latter, −1 where another change is nearly as large.
        """
        if rows.shape[1] > MOST_DIMENSIONS or (place != "actions" and name not in self._lengths):
            return
        rows = np.nan_to_num(rows.astype(np.float64), posinf=0, neginf=0)
        if place == "actions":
            self._lengths[name], self._tasks[name], self._controls = len(rows), task, rows
            self._sampled[name] = rows[:: 1 + len(rows) // SAMPLED]
        with np.errstate(over="ignore", invalid="ignore"):
            after = np.concatenate([rows[1:], rows[-1:]])
            changes = np.abs(after - rows)
            turned = np.abs(after + rows) < (1 - NEARLY) * changes  # as a quaternion
            for turn in TURNS.values():
                turned |= np.abs(changes - turn) < (1 - NEARLY) * turn
            moves = np.where(turned, 0, changes)
            second, largest = np.partition(np.concatenate([0 * rows[:1], moves]), -2, axis=0)[-2:]
            at = np.where(largest > JUMP * second, moves.argmax(0), -1)
            found = [np.abs(rows).max(0), np.ptp(rows, axis=0), changes.mean(0), largest, at]
            phase = np.cos(np.pi * np.outer(np.arange(len(rows)) / len(rows), (1, 2, 3)))
            around = phase if place == "actions" else np.concatenate([rows, after - rows], axis=1)
            self._statistics.setdefault(place, {})[name] = np.nan_to_num(np.stack(found), posinf=0)
            self._correlations.setdefault(place, {})[name] = _correlations(self._controls, around)

    def discard(self, name: str) -> None:
        """Forget a demonstration."""
        known: list[dict[str, Any]] = [self._lengths, self._tasks, self._sampled]
        for kept in (*known, *self._statistics.values(), *self._correlations.values()):
            kept.pop(name, None)

    def add_all(self, demo: Demonstration, keys: Collection[str]) -> None:
        """Add the controls of a demonstration, and its observations with these keys, except pictures."""
        arrays = {"actions": demo.actions} | {f"obs/{key}": demo.observations[key] for key in keys}
        for place, array in arrays.items():
            if not is_picture(array):
                self.add(demo.name, place, np.asarray(array).reshape(len(demo), -1), task_of(demo.attributes))

    def usual(self, frequency: float | None) -> Usual:
        """What the demonstrations have in common."""
        extremes = {place: np.quantile(each, (0, 0.5, 1), axis=0).tolist() for place, each in self._each.items()}
        reference, agreement = self._agreement()
        least = np.quantile(agreement, 0.1, axis=0).tolist()
        return Usual(extremes, reference.tolist(), least, self._length, frequency, self.unlike())

    def unlike(self, usual: Usual | None = None, frequency: float | None = None) -> dict[str, str]:
        """Why demonstrations are unlike the others of their task, or unlike the usual ones of a fit, by their names.

        :param frequency: control steps per second of these demonstrations, Hz.
        """
        reasons: dict[str, str] = {}
        if usual is None and are_several([*self._tasks.values()]):
            for task in dict.fromkeys(self._tasks.values()):
                part = deepcopy(self)
                for name in [name for name, own in self._tasks.items() if own != task]:
                    part.discard(name)
                reasons |= part.unlike()
            return reasons
        if len(self._lengths) < (LEAST if usual is None else 1):
            return reasons
        for found in (self._units(usual), self._reversed(usual), self._rate(usual, frequency), self._joined(usual)):
            for why, names in found.items():
                reasons |= {name: why for name in names if name not in reasons}
        return reasons

    @property
    def _length(self) -> float:
        return float(np.median([*self._lengths.values()] or [0]))

    @property
    def _each(self) -> dict[str, np.ndarray]:
        """The statistics [N, 5, D] of each array that all demonstrations have."""
        whole = sorted(place for place, known in self._statistics.items() if len(known) == len(self._lengths))
        return {place: np.stack([*self._statistics[place].values()]) for place in whole}

    def _units(self, usual: Usual | None) -> dict[str, list[str]]:
        """Names of demonstrations with numbers in other units, by why."""
        found: dict[tuple[str, ...], dict[str, list[int]]] = {}
        for place, each in self._each.items():
            for dim, own in enumerate(np.moveaxis(each[:, :3], 2, 0)):
                others = _larger_part(own) if usual is None else np.array(usual.statistics[place])[:, :3, dim]
                others = others[others.min(1) > 0]
                if len(others) > (len(own) // 2 if usual is None else 0):
                    ratios = _ratios(own, others)
                    out = tuple(name for name, ratio in zip(self._lengths, ratios, strict=True) if ratio)
                    why = _times(float(np.median(ratios[ratios > 0])), usual) if out else ""
                    found.setdefault((why, *out), {}).setdefault(place, []).append(dim)
        return {
            f"{few([f'{place} {listed(dims)}' for place, dims in about.items()])}: {why}": names
            for (why, *names), about in found.items()
            if names
        }

    def _agreement(self, usual: Usual | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The usual correlations of controls [A, F], and the cosine of each demonstration's with them [N, A]."""
        if not self._lengths:
            return np.zeros((0, 0)), np.zeros((1, 0))
        each = np.concatenate([np.stack([*self._correlations[place].values()]) for place in self._each], axis=2)
        reference = np.median(each, axis=0) if usual is None else np.array(usual.correlations)
        for _ in range(3 if usual is None else 0):  # with the signs of most demonstrations
            signs = np.where(_cosines(each, reference) < 0, -1, 1)
            reference = np.median(each * (signs * np.where(signs.sum(0) < 0, -1, 1))[..., None], axis=0)
        return reference, _cosines(each, reference)

    def _reversed(self, usual: Usual | None) -> dict[str, list[str]]:
        """Names of demonstrations with a reversed control, by why."""
        _, agreement = self._agreement(usual)
        if usual is None:
            steps = np.concatenate([*self._sampled.values()])
            low, high = steps.min(0), steps.max(0)
            rests = np.minimum(steps - low, high - steps) < 0.1 * (high - low)
            known = (rests.mean(0) > RESTS) & (np.quantile(np.abs(agreement), 0.1, axis=0) > SURE)
        else:
            known = np.array(usual.agreement) > SURE
        found: dict[str, list[str]] = {}
        for dim in np.flatnonzero(known & (agreement < -SURE).any(0)).tolist():
            why = f"control dimension {dim} has the other sign than {_where(usual)}, perhaps reversed"
            found[why] = [name for name, own in zip(self._lengths, agreement[:, dim], strict=True) if own < -SURE]
        return found

    def _joined(self, usual: Usual | None) -> dict[str, list[str]]:
        """Names of demonstrations in which numbers jump together, by why."""
        each = {place: values[:, 3:] for place, values in self._each.items() if place != "actions"}
        found: dict[str, int] = {}
        if each:
            own = np.concatenate([*each.values()], axis=2)
            known = [np.array(usual.statistics[place])[1, 3] for place in each] if usual else [np.median(own[:, 0], 0)]
            moves = np.concatenate(known)
            for name, (largest, at) in zip(self._lengths, own, strict=True):
                steps = np.bincount(at[(at >= 0) & (largest > JUMP * moves) & (moves > 0)].astype(int))
                if steps.max(initial=0) >= max(2, np.count_nonzero(moves) / 4):
                    found[name] = int(steps.argmax()) + 1
        if not found or (usual is None and 2 * len(found) > len(self._lengths)):
            return {}
        first, step = next(iter(found.items()))
        return {f"observations jump at once, in {first} at step {step}: perhaps two recordings are joined": [*found]}

    def _rate(self, usual: Usual | None, frequency: float | None) -> dict[str, list[str]]:
        """The names of all demonstrations where their rate is not that of the fit, by why."""
        if usual is None:
            return {}
        names = [*self._lengths]
        if frequency and usual.frequency:
            other = abs(math.log(frequency / usual.frequency)) > 0.05
            return {f"{frequency:g} Hz, and {usual.frequency:g} Hz in the fit": names} if other else {}
        each = {place: np.median(values[:, 2], axis=0) for place, values in self._each.items() if place != "actions"}
        changes = np.concatenate(
            [np.zeros((2, 0)), *([own, usual.statistics[place][1][2]] for place, own in each.items())], 1
        )
        moving = changes[:, changes.min(0) > 0]
        faster = float(np.median(moving[0] / moving[1])) if moving.size else 1.0
        shorter = usual.length / self._length
        if max(faster, 1 / faster) < FASTER or not 1 / FASTER < faster / shorter < FASTER:
            return {}
        return {f"steps are {faster:.2g} times as long as in the fit, perhaps at another rate": names}


def reasons_told(reasons: Mapping[str, str], number: int, remedy: str = "") -> list[str]:
    """A line for each reason why some of so many demonstrations are unlike the others, with their names."""
    names = {why: [name for name in reasons if reasons[name] == why] for why in reasons.values()}
    return [f"{few(members)} ({len(members)} of {number}): {why}{remedy}" for why, members in names.items()]


def _ratios(own: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """How many times its usual size a number has in each demonstration [N]; 0 where its units are the usual ones.

    :param own: sizes, spans and mean changes [N, 3]; ``usual`` [n, 3].
    """
    low, high = usual[:, 0].min(), usual[:, 0].max()
    apart = max(APART, high / low)
    out = (own.min(1) > 0) & ((own[:, 0] > apart * high) | (own[:, 0] < low / apart))
    ratios = own / np.median(usual, axis=0)
    alike = np.ptp(np.log(np.where(out[:, None], ratios, 1)), axis=1) < math.log(2 * NEAR)
    return np.where(out & alike, ratios[:, 0], 0.0)


def _times(ratio: float, usual: Usual | None) -> str:
    """A ratio of sizes in words, with the units that it is between."""
    size = max(ratio, 1 / ratio)
    factor = min(FACTORS, key=lambda each: abs(math.log(each / size)))
    units = " for ".join(FACTORS[factor] if ratio > 1 else FACTORS[factor][::-1])
    if not 1 / NEAR < size / factor < NEAR:
        factor, units = float(f"{size:.1g}"), "other units"
    return f"about {factor:g} times as {'large' if ratio > 1 else 'small'} as {_where(usual)}, perhaps {units}"


def _where(usual: Usual | None) -> str:
    return "in most" if usual is None else "in the fit"


def _larger_part(sizes: np.ndarray) -> np.ndarray:
    """The rows [n, 3] on that side of the largest gap between sizes, their first column, on which most are."""
    rows = sizes[sizes[:, 0].argsort()][np.count_nonzero(sizes[:, 0] == 0) :]
    cut = int(np.diff(np.log(rows[:, 0])).argmax()) + 1 if len(rows) > 1 else 0
    return max(rows[:cut], rows[cut:], key=len)


def _correlations(controls: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Correlations over time [A, F] of controls [T, A] with values [T, F]; 0 where one of both is constant."""
    left, right = (array - array.mean(0) for array in (controls, values))
    with np.errstate(all="ignore"):
        return np.nan_to_num(left.T @ right / np.outer(*(np.linalg.norm(array, axis=0) for array in (left, right))))


def _cosines(each: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The cosine [N, A] of correlations [N, A, F] with others [A, F]; 0 where one of both is 0."""
    lengths = np.linalg.norm(each, axis=-1) * np.linalg.norm(reference, axis=-1)
    with np.errstate(all="ignore"):
        return np.nan_to_num((each * reference).sum(-1) / lengths)
