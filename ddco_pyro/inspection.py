"""What is in a file of demonstrations: keys, shapes, lengths, ranges, and what would be in the way of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.hdf5 import DemonstrationsError
from ddco_pyro.sources import Column, Format, Source, open_source

NUMBERS = "fiub"
"""Kinds of numpy types that are real numbers."""


@dataclass
class Field:
    """One array over all demonstrations that have it: ``actions``, ``obs/<key>`` or ``labels/<name>``.

    :param shape: of one step.
    :param minimum: smallest finite value of each dimension, flattened, of the array's own type; empty where there is
        none, infinite where none is finite.
    :param nan: number of NaN.
    :param infinite: number of infinite values.
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

    def add(self, column: Column) -> None:
        """Take in the values of one demonstration."""
        self.demonstrations += 1
        self.video = self.video or column.video
        if column.video or column.dtype.kind not in NUMBERS:
            return
        first: np.ndarray | None = None
        for block in column.blocks():
            values = block.reshape(len(block), -1)
            first = values[:1] if first is None and len(values) else first
            self._take(values)
            self.still = self.still and (first is None or bool((values == first).all()))

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
    """What was found.

    :param lengths: steps of each demonstration by name.
    :param problems: what a fit would refuse, one line each.
    :param frequency: control steps in a second, Hz, where the file says it.
    """

    path: Path
    format: Format
    lengths: Mapping[str, int]
    fields: Mapping[str, Field]
    masks: Mapping[str, tuple[str, ...]]
    frequency: float | None
    problems: list[str] = field(default_factory=list)

    @property
    def observations(self) -> list[Field]:
        """The arrays under ``obs``."""
        return [one for place, one in self.fields.items() if place.startswith("obs/")]

    @property
    def labels(self) -> list[Field]:
        """The arrays under ``labels``."""
        return [one for place, one in self.fields.items() if place.startswith("labels/")]

    @property
    def actions(self) -> Field | None:
        """The control."""
        return self.fields.get("actions")

    def everywhere(self, one: Field) -> bool:
        """Whether every demonstration has this array."""
        return one.demonstrations == len(self.lengths)

    def as_json(self) -> dict[str, Any]:
        """The same as plain data."""
        return {
            "path": str(self.path),
            "format": self.format,
            "demonstrations": dict(self.lengths),
            "control_frequency": self.frequency,
            "masks": {name: list(names) for name, names in self.masks.items()},
            "fields": [_as_json(one) for one in self.fields.values()],
            "problems": self.problems,
        }


def _as_json(one: Field) -> dict[str, Any]:
    found = asdict(one)
    ends = {name: [float(value) if np.isfinite(value) else None for value in found[name]] for name in _ENDS}
    return found | ends | {"shape": list(one.shape), "constant": one.constant}


_ENDS = ("minimum", "maximum")


def inspect(path: str | Path, form: Format | None = None) -> Inspection:
    """Look at every array of a file or folder once, in blocks.

    :raises DemonstrationsError: it cannot be read, or holds no demonstrations.
    """
    with open_source(path, form) as source:
        return _inspect(Path(path), source)


def _inspect(path: Path, source: Source) -> Inspection:
    found = Inspection(path, source.format, {}, {}, dict(source.masks), source.frequency)
    lengths: dict[str, int] = {}
    fields: dict[str, Field] = {}
    for name in source.names:
        try:
            recording = source.recording(name)
            lengths[name] = recording.actions.shape[0] if recording.actions.shape else 0
            for place, column in recording.columns():
                _add(fields, place, column, name, lengths[name], found.problems)
        except DemonstrationsError as error:
            found.problems.append(str(error))
    for mask, names in source.masks.items():
        unknown = [name for name in names if name not in source.names]
        if unknown:
            found.problems.append(f"mask/{mask}: there is no demonstration {unknown[0]!r}")
    whole = Inspection(path, source.format, lengths, fields, found.masks, found.frequency, found.problems)
    whole.problems.extend(_problems(whole))
    return whole


def _add(fields: dict[str, Field], place: str, column: Column, name: str, steps: int, problems: list[str]) -> None:
    if column.shape[:1] != (steps,):
        had = column.shape[0] if column.shape else "no"
        problems.append(f"{name}: {place} has {had} steps, but actions has {steps}")
        return
    known = fields.get(place)
    if known is None:
        none = np.zeros(0)
        known = fields[place] = Field(place, tuple(column.shape[1:]), str(column.dtype), none, none)
    if known.shape != tuple(column.shape[1:]):
        problems.append(
            f"{name}: {place} has shape {list(column.shape[1:])} at each step, but {list(known.shape)} elsewhere"
        )
        return
    known.add(column)


def _problems(found: Inspection) -> list[str]:
    problems = []
    for one in found.fields.values():
        if not one.numeric:
            problems.append(f"{one.place} holds {one.dtype}, not numbers")
        if one.nan or one.infinite:
            problems.append(f"{one.place} has {one.nan} NaN and {one.infinite} infinite values")
        if not found.everywhere(one):
            missing = len(found.lengths) - one.demonstrations
            problems.append(f"{one.place} cannot be used in {missing} of {len(found.lengths)} demonstrations")
    empty = [name for name, steps in found.lengths.items() if steps == 0]
    if empty:
        problems.append(f"{', '.join(empty[:3])}{' ...' if len(empty) > 3 else ''}: no steps")
    if found.actions is not None and len(found.actions.shape) != 1:
        problems.append(f"actions has shape {list(found.actions.shape)} at each step, it has to be [dimensions]")
    return problems
