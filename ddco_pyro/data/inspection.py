"""What is in a file of demonstrations: keys, shapes, lengths, ranges, and what would be in the way of a fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ddco_pyro.data.checks import check_shape, check_steps, problems_of_masks
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
    excluded: tuple[str, ...] = ()
    unreadable: tuple[str, ...] = ()
    external: tuple[str, ...] = ()

    @property
    def notes(self) -> list[str]:
        """What is odd about dimensions of the control, one line each."""
        auto = control_parts(ControlSpec(), self.control) if self.control else ()
        return [*notes(self.control), *(f"{line}, by control.kind: auto" for line in described(auto))]

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
    problems: list[str] = []
    unreadable: list[str] = []
    control = ControlStatistics()
    for name in (name for name in source.names if name not in exclude):
        try:
            recording = source.recording(name)
            lengths[name] = recording.actions.shape[0] if recording.actions.shape else 0
            for place, column in recording.columns():
                watched = _watched(column, control) if place == "actions" else column
                problems += _add(fields, place, watched, name, lengths[name])
        except DemonstrationsError as error:
            problems.append(str(error))
            unreadable.append(name)
    problems += problems_of_masks(source.masks, source.names)
    masks = {mask: tuple(name for name in names if name not in exclude) for mask, names in source.masks.items()}
    external = sorted({name for file in source.files if h5py.is_hdf5(file) for name in outside_files(file)})
    inspection = Inspection(
        path, source.format, lengths, fields, masks, source.frequency, problems, control.dimensions(), exclude,
        tuple(unreadable), tuple(external),
    )  # fmt: skip
    inspection.problems.extend(_problems(inspection))
    return inspection


def _watched(column: Column, control: ControlStatistics) -> Column:
    """The same column, whose values are gathered when they are read."""

    def blocks() -> Iterator[np.ndarray]:
        for block in column.blocks():
            if block.dtype.kind in NUMBERS:
                control.add(block)
            yield block

    return replace(column, blocks=blocks)


def _add(fields: dict[str, Field], place: str, column: Column, name: str, steps: int) -> list[str]:
    """Take in an array of a demonstration; what is wrong with its shape, so that it could not be."""
    none, shape = np.zeros(0), tuple(column.shape[1:])
    try:
        check_steps(name, place, column, steps)
        known = fields.setdefault(place, Field(place, shape, str(column.dtype), none, none))
        check_shape(f"{name}: {place}", column, known.shape, "the first")
    except DemonstrationsError as error:
        return [str(error)]
    known.add(column, name)
    return []


def _problems(inspection: Inspection) -> list[str]:
    problems = []
    for array in inspection.fields.values():
        if not array.numeric:
            problems.append(f"{array.place} holds {array.dtype}, not numbers")
        if array.first is not None:
            name, step = array.first
            number = len(array.affected)
            problems.append(
                f"{array.place} has {array.unusable}, the first in {name} at step {step}; "
                f"{number} of {array.demonstrations} demonstrations {'is' if number == 1 else 'are'} affected"
            )
        if not inspection.everywhere(array):
            missing = len(inspection.lengths) - array.demonstrations
            problems.append(f"{array.place} cannot be used in {missing} of {len(inspection.lengths)} demonstrations")
    empty = [name for name, steps in inspection.lengths.items() if steps == 0]
    if empty:
        problems.append(f"{', '.join(empty[:3])}{' ...' if len(empty) > 3 else ''}: no steps")
    if inspection.actions is not None and len(inspection.actions.shape) != 1:
        problems.append(f"actions has shape {list(inspection.actions.shape)} at each step, it has to be [dimensions]")
    return problems
