"""Inspection of demonstrations: keys, shapes, lengths, ranges, unusual controls, and problems for a fit."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.checks import (
    LARGEST,
    NUMBERS,
    check_division,
    check_shape,
    check_steps,
    divided,
    problem_of_controls,
    problem_of_labels,
    problems_of_masks,
    reading,
    rounding,
    usable,
)
from ddco_pyro.data.controls import (
    FEWEST,
    MOST_DIMENSIONS,
    ControlDimension,
    control_dimensions,
    control_parts,
    described,
    few,
    listed,
    most_few,
    notes,
    same,
)
from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError
from ddco_pyro.data.pictures import blocks
from ddco_pyro.data.sources import Column, Source, open_source
from ddco_pyro.data.sources.recording import UNKNOWN, label_names
from ddco_pyro.spec import ControlSpec


@dataclass
class Field:
    """Statistics of one array over the demonstrations that have it: ``actions``, ``obs/<key>`` or ``labels/<name>``.

    :param shape: of one step.
    :param minimum: the smallest finite value of each flattened dimension, in the array's type; empty without values,
        infinite without finite values. ``maximum`` likewise.
    :param nan: number of NaN.
    :param infinite: number of infinite values.
    :param huge: number of finite values beyond the largest usable number.
    :param first: demonstration and step of the first unusable value; None if all values are usable.
    :param affected: names of the demonstrations with unusable values.
    :param still: whether the array is constant within every demonstration.
    :param demonstrations: number of demonstrations that have the array.
    :param video: whether the array is in video files, which are not decoded.
    :param unknown: number of steps of labels without ground truth.
    :param values: the labels that occur, without the unknown one.
    :param names: of labels 0, 1, ..., where the file names them.
    """

    place: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    minimum: np.ndarray
    maximum: np.ndarray
    nan: int = 0
    infinite: int = 0
    huge: int = 0
    first: tuple[str, int] | None = None
    affected: list[str] = field(default_factory=list)
    still: bool = True
    demonstrations: int = 0
    video: bool = False
    unknown: int = 0
    values: set[int] = field(default_factory=set)
    names: list[str] = field(default_factory=list)

    @property
    def key(self) -> str:
        """The name without the folder."""
        return self.place.partition("/")[2] or self.place

    @property
    def image(self) -> bool:
        """Whether a step is a picture, uint8 [H, W, C]."""
        return reading(self.shape, self.dtype)[0] == "picture"

    @property
    def numeric(self) -> bool:
        """Whether the array holds real numbers."""
        return self.dtype.kind in NUMBERS

    @property
    def problem(self) -> str:
        """The problem with the shape or type, in words; empty without a problem."""
        if self.place.startswith("obs/"):
            return reading(self.shape, self.dtype)[1]
        return (problem_of_controls if self.place == "actions" else problem_of_labels)(self.shape, self.dtype)

    @property
    def constant(self) -> list[int]:
        """Flattened dimensions that have one value in the whole file."""
        return [int(index) for index in np.flatnonzero(self.minimum == self.maximum)]

    @property
    def rounding(self) -> list[int]:
        """Dimensions of an observation that vary by :func:`~ddco_pyro.data.checks.rounding` alone."""
        if not self.place.startswith("obs/") or not self.numeric:
            return []
        spread = self.maximum.astype(np.float64) - self.minimum
        rests = spread <= rounding(self.minimum, self.maximum, self.dtype)
        return [int(index) for index in np.flatnonzero(rests & (self.minimum != self.maximum))]

    @property
    def unusable(self) -> str:
        """The number of unusable values, in words; empty without any."""
        if not self.affected:
            return ""
        huge = f" and {self.huge} beyond ±{LARGEST:g}" if self.huge else ""
        return f"{self.nan} NaN and {self.infinite} infinite values{huge}"

    def add(self, values: np.ndarray, name: str, step: int, first: np.ndarray) -> None:
        """Add a block of a demonstration.

        :param values: [steps, dimensions], at least one step.
        :param step: number of the first step.
        :param first: the demonstration's first step, [1, dimensions].
        """
        low = high = values
        if values.dtype.kind == "f":
            nan, infinite = np.isnan(values), np.isinf(values)
            self.nan, self.infinite = self.nan + int(nan.sum()), self.infinite + int(infinite.sum())
            low, high = np.where(nan | infinite, np.inf, values), np.where(nan | infinite, -np.inf, values)
        low, high = low.min(0), high.max(0)
        self.minimum = np.minimum(self.minimum, low) if len(self.minimum) else low
        self.maximum = np.maximum(self.maximum, high) if len(self.maximum) else high
        bad = ~usable(values)
        if bad.any():
            self.huge += int((bad & np.isfinite(values)).sum())
            self.first = self.first or (name, step + int(bad.any(1).argmax()))
            self.affected += [name] if name not in self.affected[-1:] else []
        if self.place.startswith("labels/"):
            self.unknown += int((values == UNKNOWN).sum())
            self.values |= {int(value) for value in np.unique(values[usable(values)]) if value != UNKNOWN}
        self.still = self.still and bool((values == first).all())

    def as_json(self) -> dict[str, Any]:
        """The statistics as plain data."""
        data = asdict(self)
        ends = {
            name: [float(value) if np.isfinite(value) else None for value in data[name]]
            for name in ("minimum", "maximum")
        }
        shown = {
            "dtype": str(self.dtype),
            "shape": list(self.shape),
            "constant": self.constant,
            "rounding": self.rounding,
            "values": sorted(self.values),
        }
        return data | ends | shown


@dataclass(frozen=True)
class Inspection:
    """The contents of a file of demonstrations.

    :param lengths: number of steps of each demonstration by name.
    :param problems: a line for each problem that a fit refuses.
    :param frequency: control steps per second, Hz; None if unknown.
    :param control: statistics of each control dimension.
    :param coincidences: a line for each kind of suspicious equality.
    :param leaks: observations, ``obs/<key>``, that hold nothing but controls still to be predicted.
    :param excluded: names of demonstrations that were skipped.
    :param unreadable: names of demonstrations that could not be read.
    :param turns: the angles in radians and the first numbers of quaternions that jump, by place of the array.
    :param odd: names of demonstrations that are dead or change the kind of a control dimension, and why.
    :param attributes: of each demonstration by its name.
    """

    path: Path
    format: str
    lengths: Mapping[str, int]
    fields: Mapping[str, Field]
    masks: Mapping[str, tuple[str, ...]]
    frequency: float | None
    problems: list[str] = field(default_factory=list)
    control: tuple[ControlDimension, ...] = ()
    coincidences: tuple[str, ...] = ()
    leaks: tuple[str, ...] = ()
    excluded: tuple[str, ...] = ()
    unreadable: tuple[str, ...] = ()
    odd: Mapping[str, str] = field(default_factory=dict)
    turns: Mapping[str, tuple[tuple[int, ...], tuple[int, ...]]] = field(default_factory=dict)
    attributes: Mapping[str, Mapping[str, Attribute]] = field(default_factory=dict)

    @property
    def exclusions(self) -> list[str]:
        """A line for each reason to exclude demonstrations, with their names."""
        names = {why: [name for name in self.odd if self.odd[name] == why] for why in self.odd.values()}
        return [
            f"{few(members)}: {why}; exclude {'them' if len(members) > 1 else 'it'}" for why, members in names.items()
        ]

    @property
    def notes(self) -> list[str]:
        """A line for each odd demonstration, unusual control dimension, coincidence, and kind of control."""
        auto = control_parts(ControlSpec(), self.control) if self.control else ()
        kinds = (f"{line}, by control.kind: auto" for line in described(auto))
        return [*self.exclusions, *notes(self.control), *self.coincidences, *kinds]

    @property
    def affected(self) -> list[str]:
        """Names of the demonstrations with unusable values, in order."""
        names = {name for array in self.fields.values() for name in array.affected}
        return [name for name in self.lengths if name in names]

    @property
    def observations(self) -> list[Field]:
        """The arrays under ``obs``."""
        return [array for place, array in self.fields.items() if place.startswith("obs/")]

    @property
    def labels(self) -> list[Field]:
        """The arrays under ``labels``."""
        return [array for place, array in self.fields.items() if place.startswith("labels/")]

    @property
    def actions(self) -> Field | None:
        """The control."""
        return self.fields.get("actions")

    def everywhere(self, array: Field) -> bool:
        """Whether every demonstration has this array."""
        return array.demonstrations == len(self.lengths)

    def as_json(self) -> dict[str, Any]:
        """The inspection as plain data."""
        return {
            "path": str(self.path),
            "format": self.format,
            "demonstrations": dict(self.lengths),
            "control_frequency": self.frequency,
            "masks": {name: list(names) for name, names in self.masks.items()},
            "fields": [array.as_json() for array in self.fields.values()],
            "control_dimensions": [dimension.as_data() for dimension in self.control],
            "odd": dict(self.odd),
            "notes": self.notes,
            "problems": self.problems,
        }


def inspect(path: str | Path, form: str | None = None, exclude: Sequence[str] = ()) -> Inspection:
    """Read every array of a file or folder once, in blocks.

    :param exclude: names of demonstrations to skip.
    :raises DemonstrationsError: the source cannot be read, or holds no demonstrations.
    """
    with open_source(path, form) as source:
        return _Inspector(source, tuple(exclude)).inspection(Path(path))


@dataclass
class _Turns:
    """Jumps of single numbers of a vector by a turn, and of quaternions to their negative, from step to step.

    :param jumps: for each turn, the number of steps [D] in which a number changes by nearly that much; ``between``
        where it changes by a quarter of a turn or more.
    :param unit: whether each four numbers [D - 3] have always been a unit quaternion; ``flips`` counts changes of sign.
    :param names: of the demonstrations with any jump or flip.
    """

    jumps: np.ndarray
    between: np.ndarray
    unit: np.ndarray
    flips: np.ndarray
    names: list[str] = field(default_factory=list)
    first: np.ndarray | None = None

    @classmethod
    def of(cls, size: int) -> _Turns:
        """Of a vector of so many numbers, before any step."""
        four = max(size - 3, 0)
        empty = np.zeros((len(TURNS), size), int)
        return cls(empty, empty.copy(), np.ones(four, dtype=bool), np.zeros(four, int))

    def add(self, rows: np.ndarray, name: str) -> None:
        """Add a demonstration [T, D]; it may begin with another sign than the first one."""
        values = rows.astype(np.float64)
        pairs = values if self.first is None else np.concatenate([self.first, values])
        self.first = values[:1] if self.first is None else self.first
        with np.errstate(invalid="ignore", over="ignore"):
            if len(self.unit):
                self.unit &= (np.abs(_fours(values * values) - 1) < UNIT).all(0)
            changes = np.abs(np.diff(values, axis=0))
            jumps = np.stack([(changes > NEARLY * turn).sum(0) for turn in TURNS.values()])
            self.between += np.stack([(changes > turn / 4).sum(0) for turn in TURNS.values()]) - jumps
            flips = (_fours(pairs[1:] * pairs[:-1]) < -NEARLY).sum(0) if len(self.unit) else self.flips * 0
        self.jumps += jumps
        self.flips += flips
        if jumps.any() or (flips > 0)[self.unit].any():
            self.names.append(name)

    @property
    def quaternions(self) -> list[int]:
        """The first number of each unit quaternion that flips its sign."""
        firsts: list[int] = []
        for place in np.flatnonzero(self.unit & (self.flips > 0)).tolist():
            firsts += [place] if not firsts or place >= firsts[-1] + 4 else []
        return firsts

    def angles(self, low: np.ndarray, high: np.ndarray) -> dict[str, list[int]]:
        """Numbers within ``low`` and ``high`` [D] that jump by a turn and never by half of one, by the unit."""
        taken = {first + place for first in self.quaternions for place in range(4)}
        wrapping = {}
        for (unit, turn), jumps, between in zip(TURNS.items(), self.jumps, self.between, strict=True):
            spread = high.astype(np.float64) - low
            wraps = (jumps > 0) & (10 * between <= jumps) & (spread >= NEARLY * turn) & (spread <= 1.02 * turn)
            wrapping[unit] = [place for place in np.flatnonzero(wraps).tolist() if place not in taken]
        return wrapping


def _fours(products: np.ndarray) -> np.ndarray:
    """Sums [T, D - 3] of each four neighbouring numbers [T, D]."""
    sums: np.ndarray = np.lib.stride_tricks.sliding_window_view(products, 4, axis=1).sum(-1)
    return sums


class _Inspector:
    """One pass over all arrays of a source, which feeds every statistic."""

    def __init__(self, source: Source, exclude: tuple[str, ...]) -> None:
        self.source, self.exclude = source, exclude
        self.fields: dict[str, Field] = {}
        self.lengths: dict[str, int] = {}
        self.attributes: dict[str, Mapping[str, Attribute]] = {}
        self.problems: dict[tuple[str, str], list[str]] = {}  # messages by kind and subject
        self.controls: dict[str, np.ndarray] = {}
        self.coincidences = _Coincidences()
        self.turns: dict[str, _Turns] = {}

    def inspection(self, path: Path) -> Inspection:
        """Read everything."""
        source, exclude, fields = self.source, self.exclude, self.fields
        unreadable: list[str] = []
        places: dict[str, Collection[str]] = {}
        names = [name for name in source.names if name not in exclude]
        for name in names:
            try:
                places[name] = self._read(name)
            except DemonstrationsError as error:
                self._problem("unreadable", str(error), re.sub(r"\d+", "", str(error).removeprefix(name)))
                unreadable.append(name)
                self.coincidences.digests.pop(name, None)
                self.controls.pop(name, None)
        for name, there in places.items():
            for place in (place for place in fields if place not in there):
                self._problem("missing", f"{name}: {place} is missing", place)
        masks = {mask: tuple(name for name in members if name not in exclude) for mask, members in source.masks.items()}
        self._name_labels()
        dimensions = control_dimensions(self.controls)
        varying = [dimension.number for dimension in dimensions if not dimension.constant]
        kinds = (
            messages[0] if len(messages) == 1 else f"{messages[0]}; the first of {len(messages)} such"
            for messages in self.problems.values()
        )
        return Inspection(
            path=path,
            format=source.format,
            lengths=self.lengths,
            fields=fields,
            masks=masks,
            frequency=source.frequency,
            problems=[*kinds, *_problems_of_division(source, names, masks), *_problems(fields, self.lengths)],
            control=dimensions,
            coincidences=(*self.coincidences.notes(masks, varying), *self._jumps()),
            turns={place: self._turning(place) for place in self.turns if any(self._turning(place))},
            leaks=tuple(p for p, array in fields.items() if self.coincidences.leaks(p, varying, array.constant)),
            excluded=exclude,
            unreadable=tuple(unreadable),
            odd=self._odd(dimensions),
            attributes=self.attributes,
        )

    def _odd(self, dimensions: Sequence[ControlDimension]) -> dict[str, str]:
        """Names of demonstrations to exclude, and why.

        Dead ones are, and the few without which a control dimension is a switch.
        """
        if any(dimension.integer for dimension in dimensions):
            return {}
        long = {name: rows for name, rows in self.controls.items() if len(rows) >= FEWEST}
        still = {name: rows for name, rows in long.items() if same(rows.min(0).astype(float), rows.max(0)).all()}
        dead = [name for name, rows in still.items() if not rows.any()]
        others = [name for name in still if name not in dead]
        reasons = dict.fromkeys(dead, "all commands are 0") if 2 * len(dead) < len(self.lengths) else {}
        if len(others) <= most_few(len(self.lengths)):
            reasons |= dict.fromkeys(others, "all commands are the same")
        for dimension in dimensions:
            for name in () if dimension.values else dimension.strays:
                reasons.setdefault(
                    name, f"control dimension {dimension.number} has further values there, and is a switch elsewhere"
                )
        return {name: reasons[name] for name in self.lengths if name in reasons}

    def _turning(self, place: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """The angles in radians and the quaternions of an array that jump."""
        array, turns = self.fields[place], self.turns[place]
        return tuple(turns.angles(array.minimum, array.maximum)["2π"]), tuple(turns.quaternions)

    def _jumps(self) -> Iterator[str]:
        """A line for the angles of an array that jump by a turn, and for its quaternions that change their sign."""
        for place, turns in self.turns.items():
            where, seen = f"the first in {few(turns.names[:1])}", place != "actions"
            for unit, numbers in turns.angles(self.fields[place].minimum, self.fields[place].maximum).items():
                remedy = f"with angles: {numbers} beside its key networks read sine and cosine" if seen else "unwrap it"
                if seen and unit != "2π":
                    remedy = f"store radians; {remedy}"
                if numbers:
                    jump = f"jump{'s' * (len(numbers) == 1)} by {unit} as an angle"
                    yield f"{place}: {listed(numbers)} {jump}, {where}: {remedy}"
            if numbers := turns.quaternions:
                remedy = f"with quaternions: {numbers} beside its key networks read products, the same for q and −q"
                yield (
                    f"{place}: {listed([first + part for first in numbers for part in range(4)])} change sign as a "
                    f"quaternion, {where}: {remedy if seen else 'give all rotations one sign'}"
                )

    def _name_labels(self) -> None:
        try:
            for name, names in label_names(self.source.attributes).items():
                if array := self.fields.get(f"labels/{name}"):
                    array.names = names
        except DemonstrationsError as error:
            self._problem("names", str(error), "labels")

    def _read(self, name: str) -> set[str]:
        """Read a demonstration; the places of its arrays."""
        recording = self.source.recording(name)
        steps = self.lengths[name] = recording.actions.shape[0] if recording.actions.shape else 0
        self.attributes[name] = recording.attributes
        self.coincidences.digests[name] = hashlib.sha256()
        for place, column in recording.columns():
            try:
                check_steps(name, place, column, steps)
                none, shape = np.zeros(0), tuple(column.shape[1:])
                array = self.fields.setdefault(place, Field(place, shape, column.dtype, none, none))
                check_shape(f"{name}: {place}", column, array.shape, "the first")
            except DemonstrationsError as error:
                self._problem("shape", str(error), place)
            else:
                array.demonstrations += 1
                array.video = array.video or column.video
                if not column.video and column.dtype.kind in NUMBERS:
                    self._read_column(array, column, name)
        return {place for place, _ in recording.columns()}

    def _read_column(self, array: Field, column: Column, name: str) -> None:
        """Feed an array to every statistic: in blocks, and whole if its steps are narrow."""
        place, step = array.place, 0
        whole = column.array() if place == "actions" or math.prod(array.shape) <= WIDEST else None
        first = np.zeros((0, 0))
        label, digest = place.startswith("labels/"), self.coincidences.digests[name]
        if not label:
            digest.update(place.encode())
        for block in column.blocks() if whole is None else blocks(whole):
            if not len(block):
                continue
            values = block.reshape(len(block), -1)
            first = first if step else values[:1].copy()
            if not label:
                digest.update(np.ascontiguousarray(values).tobytes())
            array.add(values, name, step, first)
            step += len(values)
        if label or whole is None or not step:
            return
        values = whole.reshape(len(whole), -1)
        if place == "actions":
            self.controls[name] = whole
        elif not array.image and name in self.controls:
            self.coincidences.compare(place, values, self.controls[name].reshape(len(self.controls[name]), -1))
        if array.dtype.kind == "f" and values.shape[1] <= MOST_DIMENSIONS:
            self.turns.setdefault(place, _Turns.of(values.shape[1])).add(values, name)

    def _problem(self, kind: str, message: str, about: str) -> None:
        self.problems.setdefault((kind, about), []).append(message)


def _problems_of_division(source: Source, names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
    strangers = list(problems_of_masks(source.masks, source.names))
    yield from strangers
    if not strangers:
        try:
            check_division(names, masks)
        except DemonstrationsError as error:
            yield str(error)


def _problems(fields: Mapping[str, Field], lengths: Mapping[str, int]) -> Iterator[str]:
    for array in fields.values():
        if problem := array.problem:
            yield f"{array.place} {problem}"
        if array.first is not None:
            name, step = array.first
            affected = len(array.affected)
            yield (
                f"{array.place} has {array.unusable}, the first in {name} at step {step}; "
                f"{affected} of {array.demonstrations} demonstrations {'is' if affected == 1 else 'are'} affected"
            )
    empty = [name for name, steps in lengths.items() if steps == 0]
    if empty:
        yield f"{', '.join(empty[:3])}{' ...' if len(empty) > 3 else ''}: no steps"


# --- coincidences -----------------------------------------------------------------------------------------------------

LOOKED_AT = 1000
"""Steps of each demonstration in which observations are compared with controls."""

WIDEST = 10_000
"""Largest array, in numbers per step, of which a demonstration is read at once, and compared with controls."""

TURNS = {"2π": 2 * math.pi, "360": 360.0}
"""A turn in radians and in degrees, and what it is called."""

NEARLY = 0.85
"""A change of an angle by this part of a turn is a jump by a turn."""

UNIT = 0.02
"""The squared length of a unit quaternion is within this distance of 1."""

SHIFTS = {0: "at the same step", 1: "of the next step", -1: "of the step before"}
"""Steps by which a control follows the observation that equals it."""


class _Coincidences:
    """Copied demonstrations, and controls among the observations."""

    def __init__(self) -> None:
        self.digests: dict[str, Any] = {}  # by demonstration, of all its arrays but labels
        self._equal: dict[str, np.ndarray] = {}  # by place, for each shift, [D, A]: whether they are always equal
        self._compared: dict[str, np.ndarray] = {}  # number of compared steps, for each shift

    def compare(self, place: str, rows: np.ndarray, commands: np.ndarray) -> None:
        """Update which numbers of an observation [T, D] equal controls [T, A] of the same or a neighbouring step."""
        rows = rows[:LOOKED_AT]
        commands = commands[: len(rows)]
        floats = [array.dtype for array in (rows, commands) if array.dtype.kind == "f"]
        coarser = min(floats, key=lambda dtype: dtype.itemsize, default=np.dtype(np.float64))
        with np.errstate(over="ignore"):
            rows, commands = rows.astype(coarser), commands.astype(coarser)
        shape = (len(SHIFTS), rows.shape[1], commands.shape[1])
        equal = self._equal.setdefault(place, np.ones(shape, dtype=bool))
        compared = self._compared.setdefault(place, np.zeros(len(SHIFTS), dtype=int))
        for at, shift in enumerate(SHIFTS):
            observed = rows[max(-shift, 0) : max(len(rows) - max(shift, 0), 0)]
            ahead = commands[max(shift, 0) :][: len(observed)]
            compared[at] += len(observed)
            for dimension in np.flatnonzero(equal[at].any(0)):
                equal[at, :, dimension] &= (observed == ahead[:, [dimension]]).all(0)

    def notes(self, masks: Mapping[str, Sequence[str]], varying: Sequence[int]) -> list[str]:
        """A line for each kind of coincidence, with a count and the first place."""
        return [*self._copies(masks), *self._observed(varying)]

    def leaks(self, place: str, varying: Sequence[int], still: Sequence[int]) -> bool:
        """Whether an observation holds nothing but controls that are still to be predicted.

        :param still: the constant dimensions of the observation.
        """
        if place not in self._equal:
            return False
        copied = [self._controls(place, shift, varying)[0] for shift in (0, 1)]
        rest = set(range(self._equal[place].shape[1])) - set(still)
        return bool(rest) and rest <= {*copied[0], *copied[1]}

    def _controls(self, place: str, shift: int, varying: Sequence[int]) -> tuple[list[int], list[int]]:
        """The dimensions of an observation that equal controls ``shift`` steps later, and those control dimensions."""
        at = list(SHIFTS).index(shift)
        if not self._compared[place][at]:
            return [], []
        equal = self._equal[place][at][:, list(varying)]
        observed, controls = np.flatnonzero(equal.any(1)).tolist(), np.flatnonzero(equal.any(0)).tolist()
        return observed, [varying[column] for column in controls]

    def _observed(self, varying: Sequence[int]) -> Iterator[str]:
        for place in self._equal:
            for shift, when in SHIFTS.items():
                observed, controls = self._controls(place, shift, varying)
                if observed:
                    effect = "tend to repeat it" if shift < 0 else "see what they have to predict"
                    yield (
                        f"{place}: {listed(observed)} = control {listed(controls)} {when}, in all {len(self.digests)} "
                        f"demonstrations, the first {next(iter(self.digests))}: policies {effect}"
                    )

    def _copies(self, masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
        known: dict[bytes, str] = {}
        each = [(known.setdefault(digest.digest(), name), name) for name, digest in self.digests.items()]
        pairs = [(first, again) for first, again in each if first != again]
        effect = "one of two that are the same may be trained on and the other held out"
        if masks.keys() & {"train", "valid"}:
            try:
                valid = set(divided(list(self.digests), masks)[1])
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
