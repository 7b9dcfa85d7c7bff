"""What is in a file of demonstrations: keys, shapes, lengths, ranges, and what would be in the way of a fit."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ddco_pyro.data.checks import (
    check_division,
    check_shape,
    check_steps,
    problem_of_controls,
    problem_of_labels,
    problem_of_pictures,
    problems_of_masks,
)
from ddco_pyro.data.coincidences import Coincidences
from ddco_pyro.data.control_dimensions import ControlDimension, ControlStatistics, notes
from ddco_pyro.data.control_parts import control_parts, described
from ddco_pyro.data.hdf5 import DemonstrationsError, outside_files
from ddco_pyro.data.pictures import MOVED
from ddco_pyro.data.sources import Column, Format, Source, open_source
from ddco_pyro.data.values import LARGEST, NUMBERS, rounding, usable
from ddco_pyro.spec import ControlSpec


@dataclass
class Field:
    """One array over all demonstrations that have it: ``actions``, ``obs/<key>`` or ``labels/<name>``.

    :param shape: of one step.
    :param minimum: smallest finite value of each dimension, flattened, of the array's own type; empty where there is
        none, infinite where none is finite.
    :param nan: number of NaN.
    :param infinite: number of infinite values.
    :param huge: number of finite values that are larger than any that can be used.
    :param first: demonstration and step of the first value that cannot be used; None where all can.
    :param affected: names of the demonstrations with such values.
    :param constant: dimensions (flattened) that have one value in the whole file.
    :param still: whether it never changes within a demonstration.
    :param demonstrations: how many demonstrations have it.
    :param video: whether it lies in videos, which are not looked into.
    """

    place: str
    shape: tuple[int, ...]
    dtype: str
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

    @property
    def key(self) -> str:
        """Its name without the folder."""
        return self.place.partition("/")[2] or self.place

    @property
    def image(self) -> bool:
        """Whether a step of it is a picture, uint8 [H, W, C]."""
        return self.dtype == "uint8" and len(self.shape) == 3

    @property
    def numeric(self) -> bool:
        """Whether it holds real numbers."""
        return np.dtype(self.dtype).kind in NUMBERS

    @property
    def problem(self) -> str:
        """What is wrong with its shape or type; nothing where nothing is."""
        if self.place == "actions":
            return problem_of_controls(self.shape, np.dtype(self.dtype))
        ask = problem_of_labels if self.place.startswith("labels/") else problem_of_pictures
        return ask(self.shape, np.dtype(self.dtype))

    @property
    def constant(self) -> list[int]:
        """Dimensions that never change in the whole file."""
        return [int(index) for index in np.flatnonzero(self.minimum == self.maximum)]

    @property
    def rounding(self) -> list[int]:
        """Dimensions of an observation that change, but by :func:`~ddco_pyro.data.values.rounding` alone."""
        if not self.place.startswith("obs/") or not self.numeric:
            return []
        spread = self.maximum.astype(np.float64) - self.minimum
        rests = spread <= rounding(self.minimum, self.maximum, np.dtype(self.dtype))
        return [int(index) for index in np.flatnonzero(rests & (self.minimum != self.maximum))]

    @property
    def unusable(self) -> str:
        """How many values cannot be used, in words; empty where all can."""
        if not self.affected:
            return ""
        huge = f" and {self.huge} beyond ±{LARGEST:g}" if self.huge else ""
        return f"{self.nan} NaN and {self.infinite} infinite values{huge}"

    def add(self, column: Column, name: str) -> None:
        """Take in the values of the demonstration of this name."""
        self.demonstrations += 1
        self.video = self.video or column.video
        if column.video or column.dtype.kind not in NUMBERS:
            return
        first: np.ndarray | None = None
        step = 0
        for block in column.blocks():
            values = block.reshape(len(block), -1)
            first = values[:1] if first is None and len(values) else first
            self._take(values)
            self._look_for_unusable(values, name, step)
            self.still = self.still and (first is None or bool((values == first).all()))
            step += len(values)

    def _look_for_unusable(self, values: np.ndarray, name: str, step: int) -> None:
        """Where values [steps, dimensions] from this step on cannot be used."""
        bad = ~usable(values)
        if bad.any():
            self.huge += int((bad & np.isfinite(values)).sum())
            self.first = self.first or (name, step + int(bad.any(1).argmax()))
            self.affected += [name] if name not in self.affected[-1:] else []

    def _take(self, values: np.ndarray) -> None:
        if values.dtype.kind == "f":
            nan, infinite = np.isnan(values), np.isinf(values)
            self.nan, self.infinite = self.nan + int(nan.sum()), self.infinite + int(infinite.sum())
            bad = nan | infinite
            low, high = np.where(bad, np.inf, values), np.where(bad, -np.inf, values)
        else:
            low = high = values
        if len(values):
            low, high = low.min(0), high.max(0)
            self.minimum = np.minimum(self.minimum, low) if len(self.minimum) else low
            self.maximum = np.maximum(self.maximum, high) if len(self.maximum) else high


@dataclass(frozen=True)
class Inspection:
    """What is in a file of demonstrations.

    :param lengths: steps of each demonstration by name.
    :param problems: what a fit would refuse, one line each.
    :param frequency: control steps in a second, Hz, where the file says it.
    :param control: what each dimension of the control does.
    :param coincidences: what is the same where it should not be, one line for each kind.
    :param leaks: the observations, ``obs/<key>``, that hold nothing but the controls that a policy has to predict.
    :param excluded: names of demonstrations that were not looked at.
    :param unreadable: names of demonstrations that could not be read.
    :param external: other files that the HDF5 file names as parts of it; they are not read.
    """

    path: Path
    format: Format
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
    external: tuple[str, ...] = ()

    @property
    def notes(self) -> list[str]:
        """What is odd about the control and about what coincides, one line each."""
        auto = control_parts(ControlSpec(), self.control) if self.control else ()
        kinds = (f"{line}, by control.kind: auto" for line in described(auto))
        return [*notes(self.control), *self.coincidences, *kinds]

    @property
    def affected(self) -> list[str]:
        """Names of the demonstrations in which some value cannot be used, in order."""
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

    @property
    def versions(self) -> dict[str, str]:
        """Keys of vectors of which the file has other versions, of moved pictures, with the keys of those."""
        pairs = ((field, self.fields.get(f"obs/{field.key}{MOVED}")) for field in self.observations)
        return {
            field.key: other.key
            for field, other in pairs
            if other and other.shape[1:] == field.shape and not other.affected and self.everywhere(other)
        }

    def everywhere(self, array: Field) -> bool:
        """Whether every demonstration has this array."""
        return array.demonstrations == len(self.lengths)

    def as_json(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "path": str(self.path),
            "format": self.format,
            "demonstrations": dict(self.lengths),
            "control_frequency": self.frequency,
            "masks": {name: list(names) for name, names in self.masks.items()},
            "fields": [_as_json(array) for array in self.fields.values()],
            "control_dimensions": [dimension.as_data() for dimension in self.control],
            "external": list(self.external),
            "notes": self.notes,
            "problems": self.problems,
        }


def _as_json(array: Field) -> dict[str, Any]:
    data = asdict(array)
    ends = {name: [float(value) if np.isfinite(value) else None for value in data[name]] for name in _ENDS}
    return data | ends | {"shape": list(array.shape), "constant": array.constant, "rounding": array.rounding}


_ENDS = ("minimum", "maximum")


def inspect(path: str | Path, form: Format | None = None, exclude: Sequence[str] = ()) -> Inspection:
    """Look at every array of a file or folder once, in blocks.

    :param exclude: names of demonstrations that are not looked at.
    :raises DemonstrationsError: it cannot be read, or holds no demonstrations.
    """
    with open_source(path, form) as source:
        return _inspect(Path(path), source, tuple(exclude))


def _inspect(path: Path, source: Source, exclude: tuple[str, ...]) -> Inspection:
    lengths: dict[str, int] = {}
    fields: dict[str, Field] = {}
    problems = _Problems()
    unreadable: list[str] = []
    places: dict[str, Collection[str]] = {}
    control, coincidences = ControlStatistics(), Coincidences()
    names = [name for name in source.names if name not in exclude]
    for name in names:
        try:
            recording = source.recording(name)
            lengths[name] = recording.actions.shape[0] if recording.actions.shape else 0
            coincidences.begin(name, lengths[name])
            for place, column in recording.columns():
                watched = coincidences.watched(place, column)
                watched = _watched(watched, control) if place == "actions" else watched
                _add(fields, place, watched, name, lengths[name], problems)
            places[name] = {place for place, _ in recording.columns()}
        except DemonstrationsError as error:
            problems.add("unreadable", str(error), re.sub(r"\d+", "", str(error).removeprefix(name)))
            unreadable.append(name)
            coincidences.forget(name)
    for name, there in places.items():
        for place in (place for place in fields if place not in there):
            problems.add("missing", f"{name}: {place} is missing", place)
    masks = {mask: tuple(name for name in members if name not in exclude) for mask, members in source.masks.items()}
    external = sorted({name for file in source.files if h5py.is_hdf5(file) for name in outside_files(file)})
    dimensions = control.dimensions()
    varying = [dimension.number for dimension in dimensions if not dimension.constant]
    return Inspection(
        path,
        source.format,
        lengths,
        fields,
        masks,
        source.frequency,
        [*problems.lines(), *_problems_of_division(source, names, masks), *_problems(fields, lengths)],
        dimensions,
        tuple(coincidences.notes(masks, varying)),
        tuple(place for place, array in fields.items() if coincidences.leaks(place, varying, array.constant)),
        exclude,
        tuple(unreadable),
        tuple(external),
    )


class _Problems:
    """Problems of demonstrations, of which each kind is told once."""

    def __init__(self) -> None:
        self._first: dict[tuple[str, str], str] = {}
        self._number: dict[tuple[str, str], int] = {}

    def add(self, kind: str, message: str, about: str) -> None:
        """A problem of a kind about something, such as a place in the file."""
        self._first.setdefault((kind, about), message)
        self._number[kind, about] = self._number.get((kind, about), 0) + 1

    def lines(self) -> list[str]:
        """The first problem of each kind, with the number of all."""
        numbers = ((message, self._number[key]) for key, message in self._first.items())
        return [message if number == 1 else f"{message}; the first of {number} such" for message, number in numbers]


def _watched(column: Column, control: ControlStatistics) -> Column:
    """The same column, whose values are gathered when they are read."""

    def blocks() -> Iterator[np.ndarray]:
        for block in column.blocks():
            if block.dtype.kind in NUMBERS:
                control.add(block)
            yield block

    return replace(column, blocks=blocks)


def _add(fields: dict[str, Field], place: str, column: Column, name: str, steps: int, problems: _Problems) -> None:
    """Take in an array of a demonstration, unless its shape is wrong."""
    none, shape = np.zeros(0), tuple(column.shape[1:])
    try:
        check_steps(name, place, column, steps)
        known = fields.setdefault(place, Field(place, shape, str(column.dtype), none, none))
        check_shape(f"{name}: {place}", column, known.shape, "the first")
    except DemonstrationsError as error:
        problems.add("shape", str(error), place)
    else:
        known.add(column, name)


def _problems_of_division(source: Source, names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """What keeps demonstrations from being divided into those to train with and those to validate with."""
    strangers = list(problems_of_masks(source.masks, source.names))
    yield from strangers
    if not strangers:
        try:
            check_division(names, masks)
        except DemonstrationsError as error:
            yield str(error)


def _problems(fields: Mapping[str, Field], lengths: Mapping[str, int]) -> list[str]:
    """What is wrong with arrays, of whatever demonstration."""
    problems = []
    for array in fields.values():
        if not array.numeric:
            problems.append(f"{array.place} holds {array.dtype}, not numbers")
        elif problem := array.problem:
            problems.append(f"{array.place} {problem}")
        if array.first is not None:
            name, step = array.first
            number = len(array.affected)
            problems.append(
                f"{array.place} has {array.unusable}, the first in {name} at step {step}; "
                f"{number} of {array.demonstrations} demonstrations {'is' if number == 1 else 'are'} affected"
            )
    empty = [name for name, steps in lengths.items() if steps == 0]
    if empty:
        problems.append(f"{', '.join(empty[:3])}{' ...' if len(empty) > 3 else ''}: no steps")
    return problems
