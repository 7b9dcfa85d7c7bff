"""What demonstrations have in common, and which are unlike the others of their file, or those of a fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

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

Sizes, spans and mean changes have the same ratio within twice this: a number that moves more has not other
units."""

SURE = 0.5
"""A demonstration agrees with the usual correlations of a control if their cosine is above; below −SURE it is
reversed.

Reversing changes every sign; where nine in ten demonstrations are sure, none lies between by chance."""

RESTS = 0.4
"""A control is a gripper's if this share of its steps lies within a tenth of its range from the ends.

These are .5 and more of grippers' steps, and at most .32 of others', whose sign depends on where an object
is."""

JUMP = 2.0
"""Numbers jump if they change by so many times their usual largest change, and any other change of the
demonstration.

Where recordings are joined, a quarter of the moving numbers and two at least do so at once."""

OTHER_RATE = 0.05
"""Rates are of other data if their logarithms differ by more."""

FASTER = 2.0
"""Where no rate is known, another one makes steps longer by this factor at least, and demonstrations shorter
by about as much."""

SAMPLED = 200
"""Steps of each demonstration, about, by which a control's range is judged."""

EXCLUDE = "; exclude such ones (demonstrations.exclude)"
"""The remedy where a fit is to be made."""


@dataclass(frozen=True)
class Traits:
    """What is compared of a demonstration.

    :param steps: their number.
    :param sampled: some of its controls [S, A].
    :param sizes: by place, the size, the span, and the mean and the largest change in a step of each number
        [4, D].
    :param jumps: by place, the step of each largest change; -1 where another is nearly as large [D].
    :param correlations: by place, of each control with each number, its change, for ``actions`` time [A, F].
    """

    name: str
    task: str
    steps: int
    sampled: np.ndarray
    sizes: Mapping[str, np.ndarray]
    jumps: Mapping[str, np.ndarray]
    correlations: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Usual:
    """What the demonstrations of a fit have in common.

    :param statistics: by place, the lowest, median and highest of each of the sizes of a number [3, 4, D].
    :param correlations: of each control dimension with observations and time [A, F].
    :param agreement: the cosine with these that nine in ten demonstrations exceed [A].
    :param steps: the median number of steps.
    :param frequency: control steps per second, Hz; None if unknown.
    :param unlike: why demonstrations are unlike the others, by name.
    """

    statistics: dict[str, list[list[list[float]]]]
    correlations: list[list[float]]
    agreement: list[float]
    steps: float
    frequency: float | None
    unlike: dict[str, str]


def traits(demo: Demonstration, keys: Collection[str]) -> Traits:
    """What is compared of a demonstration and its observations with these keys, except pictures."""
    seen = {f"obs/{key}": demo.observations[key] for key in keys}
    vectors = {place: np.asarray(array) for place, array in seen.items() if not is_picture(array)}
    return traits_of(demo.name, task_of(demo.attributes), {"actions": demo.actions, **vectors})


def traits_of(name: str, task: str, arrays: Mapping[str, np.ndarray]) -> Traits:
    """What is compared of a demonstration's arrays [T, ...] by place, of which ``actions`` is the control.

    Wide arrays do not count.
    """
    control, sizes, jumps, correlations = np.zeros((0, 0)), {}, {}, {}
    for place, array in sorted(arrays.items(), key=lambda item: item[0] != "actions"):
        rows = np.nan_to_num(array.reshape(len(array), -1).astype(np.float64), posinf=0, neginf=0)
        if rows.shape[1] > MOST_DIMENSIONS:
            continue
        control = rows if place == "actions" else control
        with np.errstate(over="ignore", invalid="ignore"):
            after = np.concatenate([rows[1:], rows[-1:]])
            changes = np.abs(after - rows)
            moves = np.where(_turned(rows, after, changes), 0, changes)
            second, largest = np.partition(np.concatenate([0 * rows[:1], moves]), -2, axis=0)[-2:]
            jumps[place] = np.where(largest > JUMP * second, moves.argmax(0), -1)
            each = np.abs(rows).max(0), np.ptp(rows, axis=0), changes.mean(0), largest
            sizes[place] = np.nan_to_num(np.stack(each), posinf=0)
            phase = np.cos(np.pi * np.outer(np.arange(len(rows)) / len(rows), (1, 2, 3)))
            around = phase if place == "actions" else np.concatenate([rows, after - rows], axis=1)
            correlations[place] = _correlations(control, around)
    steps = len(control)
    return Traits(name, task, steps, control[:: 1 + steps // SAMPLED], sizes, jumps, correlations)


def usual(known: Sequence[Traits], frequency: float | None) -> Usual:
    """What demonstrations have in common; ``frequency`` is their rate, Hz."""
    sizes = _sizes(known).items()
    extremes = {place: np.quantile(each, (0, 0.5, 1), axis=0).tolist() for place, each in sizes}
    reference, agreement = _agreement(known)
    least = np.quantile(agreement, 0.1, axis=0).tolist()
    return Usual(extremes, reference.tolist(), least, _steps(known), frequency, unlike(known))


def unlike(
    known: Sequence[Traits], usual: Usual | None = None, frequency: float | None = None
) -> dict[str, str]:
    """Why demonstrations are unlike the others of their task, or the usual ones of a fit, by their names.

    :param frequency: control steps per second of these demonstrations, Hz.
    """
    tasks = [one.task for one in known]
    if usual is None and are_several(tasks):
        parts = (unlike([one for one in known if one.task == task]) for task in dict.fromkeys(tasks))
        return {name: why for part in parts for name, why in part.items()}
    if len(known) < (LEAST if usual is None else 1):
        return {}
    reasons = dict[str, str]()
    found = _other_units(known, usual), _reversed(known, usual), _other_rate(known, usual, frequency)
    for why, names in (*chain(*found), *_joined(known, usual)):
        reasons |= {name: why for name in names if name not in reasons}
    return reasons


def reasons_told(reasons: Mapping[str, str], number: int, remedy: str = "") -> list[str]:
    """A line for each reason why some of so many demonstrations are unlike the others, with their names."""
    names = {why: [name for name in reasons if reasons[name] == why] for why in reasons.values()}
    return [f"{few(members)} ({len(members)} of {number}): {why}{remedy}" for why, members in names.items()]


# --- reasons, each with the names of its demonstrations -----------------------------------------------------


def _other_units(known: Sequence[Traits], usual: Usual | None) -> Iterator[tuple[str, Sequence[str]]]:
    """Numbers in other units."""
    found: dict[tuple[str, tuple[str, ...]], dict[str, list[int]]] = {}
    for place, each in _sizes(known).items():
        for dim, own in enumerate(np.moveaxis(each[:, :3], 2, 0)):
            others = _larger_part(own) if usual is None else np.array(usual.statistics[place])[:, :3, dim]
            others = others[others.min(1) > 0]
            if len(others) > (len(own) // 2 if usual is None else 0):
                ratios = _ratios(own, others)
                if out := tuple(one.name for one, ratio in zip(known, ratios, strict=True) if ratio):
                    why = _times(float(np.median(ratios[ratios > 0])), usual)
                    found.setdefault((why, out), {}).setdefault(place, []).append(dim)
    for (why, names), about in found.items():
        yield f"{few([f'{place} {listed(dims)}' for place, dims in about.items()])}: {why}", names


def _reversed(known: Sequence[Traits], usual: Usual | None) -> Iterator[tuple[str, Sequence[str]]]:
    """Controls with the other sign."""
    _, agreement = _agreement(known, usual)
    if usual is None:
        steps = np.concatenate([one.sampled for one in known])
        low, high = steps.min(0), steps.max(0)
        rests = np.minimum(steps - low, high - steps) < 0.1 * (high - low)
        sure = (rests.mean(0) > RESTS) & (np.quantile(np.abs(agreement), 0.1, axis=0) > SURE)
    else:
        sure = np.array(usual.agreement) > SURE
    for dim in np.flatnonzero(sure & (agreement < -SURE).any(0)).tolist():
        names = [one.name for one, own in zip(known, agreement[:, dim], strict=True) if own < -SURE]
        yield f"control dimension {dim} has the other sign than {_where(usual)}, perhaps reversed", names


def _other_rate(
    known: Sequence[Traits], usual: Usual | None, frequency: float | None
) -> Iterator[tuple[str, Sequence[str]]]:
    """All demonstrations, where their rate is not that of the fit."""
    if usual is None:
        return
    names = [one.name for one in known]
    if usual.frequency and frequency:
        if abs(math.log(frequency / usual.frequency)) > OTHER_RATE:
            yield f"{frequency:g} Hz, and {usual.frequency:g} Hz in the fit", names
        return
    seen = {place: sizes for place, sizes in _sizes(known).items() if place != "actions"}
    changes = {place: np.median(sizes[:, 2], axis=0) for place, sizes in seen.items()}
    with np.errstate(all="ignore"):
        each = [own / usual.statistics[place][1][2] for place, own in changes.items()]
    ratios = np.concatenate([[1.0], *each])
    faster = float(np.median(ratios[np.isfinite(ratios) & (ratios > 0)]))
    shorter = usual.steps / _steps(known)
    if max(faster, 1 / faster) >= FASTER and 1 / FASTER < faster / shorter < FASTER:
        yield f"steps are {faster:.2g} times as long as in the fit, perhaps at another rate", names


def _joined(known: Sequence[Traits], usual: Usual | None) -> Iterator[tuple[str, Sequence[str]]]:
    """Two recordings in a demonstration: observations that jump together."""
    if not (places := [place for place in _shared(known) if place != "actions"]):
        return
    changes = np.stack([np.concatenate([one.sizes[place][3] for place in places]) for one in known])
    usually = np.median(changes, 0)
    if usual:
        usually = np.concatenate([usual.statistics[place][1][3] for place in places])
    found: dict[str, int] = {}
    for one, largest in zip(known, changes, strict=True):
        at = np.concatenate([one.jumps[place] for place in places])
        together = np.bincount(at[(at >= 0) & (usually > 0) & (largest > JUMP * usually)])
        if together.max(initial=0) >= max(2, np.count_nonzero(usually) / 4):
            found[one.name] = int(together.argmax()) + 1
    if found and (usual or 2 * len(found) <= len(known)):
        first, step = next(iter(found.items()))
        jump = f"observations jump at once, in {first} at step {step}"
        yield f"{jump}: perhaps two recordings are joined", [*found]


def _steps(known: Sequence[Traits]) -> float:
    """The median number of steps."""
    return float(np.median([one.steps for one in known]))


def _shared(known: Sequence[Traits]) -> list[str]:
    """The places of arrays that all demonstrations have."""
    return sorted(set.intersection(*({*one.sizes} for one in known))) if known else []


def _sizes(known: Sequence[Traits]) -> dict[str, np.ndarray]:
    """The sizes [N, 4, D] of each array that all demonstrations have."""
    return {place: np.stack([one.sizes[place] for one in known]) for place in _shared(known)}


def _agreement(known: Sequence[Traits], usual: Usual | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The usual correlations of controls [A, F], and the cosine of each demonstration's with them [N, A]."""
    if not (places := _shared(known)):
        return np.zeros((0, 0)), np.zeros((1, 0))
    each = np.stack([np.concatenate([one.correlations[place] for place in places], axis=1) for one in known])
    reference = np.median(each, axis=0) if usual is None else np.array(usual.correlations)
    for _ in range(3 if usual is None else 0):  # with the signs of most demonstrations
        signs = np.where(_cosines(each, reference) < 0, -1, 1)
        reference = np.median(each * (signs * np.where(signs.sum(0) < 0, -1, 1))[..., None], axis=0)
    return reference, _cosines(each, reference)


def _ratios(own: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """How many times its usual size a number has in each demonstration [N]; 0 where its units are usual.

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
    as_large = f"{factor:g} times as {'large' if ratio > 1 else 'small'} as"
    return f"about {as_large} {_where(usual)}, perhaps {units}"


def _where(usual: Usual | None) -> str:
    return "in most" if usual is None else "in the fit"


def _larger_part(sizes: np.ndarray) -> np.ndarray:
    """The rows [n, 3] on that side of the largest gap between sizes, the first column, on which most are."""
    rows = sizes[sizes[:, 0].argsort()][np.count_nonzero(sizes[:, 0] == 0) :]
    cut = int(np.diff(np.log(rows[:, 0])).argmax()) + 1 if len(rows) > 1 else 0
    return max(rows[:cut], rows[cut:], key=len)


def _turned(rows: np.ndarray, after: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Whether numbers change by a turn of an angle, or nearly to their negative, as a quaternion's [T, D]."""
    turned = np.abs(after + rows) < (1 - NEARLY) * changes
    for turn in TURNS.values():
        turned |= np.abs(changes - turn) < (1 - NEARLY) * turn
    return turned


def _correlations(controls: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Correlations over time [A, F] of controls [T, A] with values [T, F]; 0 where one is constant."""
    left, right = (array - array.mean(0) for array in (controls, values))
    with np.errstate(all="ignore"):
        lengths = np.outer(*(np.linalg.norm(array, axis=0) for array in (left, right)))
        return np.nan_to_num(left.T @ right / lengths)


def _cosines(each: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The cosine [N, A] of correlations [N, A, F] with others [A, F]; 0 where one of both is 0."""
    lengths = np.linalg.norm(each, axis=-1) * np.linalg.norm(reference, axis=-1)
    with np.errstate(all="ignore"):
        return np.nan_to_num((each * reference).sum(-1) / lengths)
