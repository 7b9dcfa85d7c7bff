"""Inspection of demonstrations: keys, shapes, lengths, ranges, unusual controls, and problems for a fit."""

from __future__ import annotations

import hashlib
import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import (
    LARGEST,
    NUMBERS,
    LazyArray,
    Observed,
    blocks,
    is_picture,
    network_input,
    usable,
)
from ddco_pyro.data.coincidences import CLOCKS, Beside, Jumps, copies, generated, jumps
from ddco_pyro.data.controls import (
    FEWEST,
    MOST_DIMENSIONS,
    ControlDimension,
    control_dimensions,
    control_parts,
    described,
    few,
    most_few,
    notes,
    rounding,
    same,
)
from ddco_pyro.data.demonstration import NOTHING, Attribute, different, problem_of
from ddco_pyro.data.demonstrations import check_division, problems_of_masks
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.labels import UNKNOWN, label_names
from ddco_pyro.data.likeness import EXCLUDE, Traits, reasons_told, traits_of, unlike
from ddco_pyro.data.sources import Source, open_source
from ddco_pyro.data.sources.metadata import clock_fault
from ddco_pyro.data.tasks import Where, are_several, by_task, task_of
from ddco_pyro.spec import ControlSpec

GAP = 3.0
"""An observed clock has a gap where a step is so many times as long as the median; computers are late."""

SLOWEST = 0.2
"""Control steps per second, Hz, below which a period may be in milliseconds: dt of 5 and more."""


@dataclass
class Field:
    """Statistics of an array over demonstrations that have it: ``actions``, ``obs/<key>``, ``labels/<name>``.

    :param shape: of one step.
    :param minimum: the smallest finite value of each flattened dimension, in the array's type; empty without
        values, infinite without finite values. ``maximum`` likewise.
    :param nan: number of NaN.
    :param infinite: number of infinite values.
    :param huge: number of finite values beyond the largest usable number.
    :param first: demonstration and step of the first unusable value; None if all values are usable.
    :param affected: names of the demonstrations with unusable values.
    :param still: whether the array is constant within every demonstration.
    :param having: names of the demonstrations that have the array.
    :param video: whether the array is in video files, which are not decoded.
    :param unknown: number of steps of labels without ground truth.
    :param values: the labels that occur, without the unknown one.
    :param of_tasks: the same by task.
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
    video: bool = False
    unknown: int = 0
    values: set[int] = field(default_factory=set)
    of_tasks: dict[str, set[int]] = field(default_factory=dict)
    having: list[str] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    @property
    def demonstrations(self) -> int:
        """Number of demonstrations that have the array."""
        return len(self.having)

    @property
    def key(self) -> str:
        """The name without the folder."""
        return self.place.partition("/")[2] or self.place

    @property
    def image(self) -> bool:
        """Whether a step is a picture, uint8 [H, W, C]."""
        return network_input(self.shape, self.dtype)[0] == "picture"

    @property
    def numeric(self) -> bool:
        """Whether the array holds real numbers."""
        return self.dtype.kind in NUMBERS

    @property
    def problem(self) -> str:
        """The problem with the shape or type, in words; empty without a problem."""
        return problem_of(self.place, self.shape, self.dtype)

    @property
    def constant(self) -> list[int]:
        """Flattened dimensions that have one value in the whole file."""
        return [int(index) for index in np.flatnonzero(self.minimum == self.maximum)]

    @property
    def rounding(self) -> list[int]:
        """Dimensions of an observation that vary by :func:`~ddco_pyro.data.controls.rounding` alone."""
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

    def add(self, values: np.ndarray, name: str, task: str, step: int, first: np.ndarray) -> None:
        """Add a block of a demonstration of a task.

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
            there = {int(value) for value in np.unique(values[usable(values)]) if value != UNKNOWN}
            self.values |= there
            self.of_tasks.setdefault(task, set()).update(there)
        self.still = self.still and bool((values == first).all())

    def as_json(self) -> dict[str, Any]:
        """The statistics as plain data."""
        ends = {
            name: [float(value) if np.isfinite(value) else None for value in getattr(self, name)]
            for name in ("minimum", "maximum")
        }
        shown: dict[str, Any] = {"dtype": str(self.dtype), "shape": [*self.shape]}
        of_tasks = {task: sorted(own) for task, own in self.of_tasks.items()}
        shown |= {"values": sorted(self.values), "of_tasks": of_tasks, "demonstrations": self.demonstrations}
        return asdict(self) | ends | shown | {"constant": self.constant, "rounding": self.rounding}


@dataclass
class Inspection:
    """The contents of a file of demonstrations.

    :param lengths: number of steps of each demonstration by name.
    :param problems: a line for each problem that a fit refuses.
    :param frequency: control steps per second, Hz; None if unknown.
    :param control: statistics of each dimension of the control, minus ``relative_to`` where there is one.
    :param coincidences: a line for each kind of suspicious equality.
    :param leaks: observations, ``obs/<key>``, that no policy should read, and why.
    :param relative_to: the observation of which the control is a target; None without one.
    :param excluded: names of demonstrations that were skipped.
    :param unreadable: names of demonstrations that could not be read.
    :param clocks: a line for the first fault of each clock among observations, and for a rate that may be a
        period in milliseconds.
    :param turns: the angles and quaternions that jump, by place of the array.
    :param odd: names of demonstrations that are dead, unlike the others, or change the kind of a control
        dimension, and why.
    :param attributes: of each demonstration by its name.
    :param where: what was asked of attributes.
    """

    path: Path
    format: str
    masks: Mapping[str, tuple[str, ...]]
    frequency: float | None
    lengths: dict[str, int] = field(default_factory=dict)
    fields: dict[str, Field] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    control: tuple[ControlDimension, ...] = ()
    coincidences: tuple[str, ...] = ()
    leaks: dict[str, str] = field(default_factory=dict)
    relative_to: str | None = None
    excluded: tuple[str, ...] = ()
    unreadable: list[str] = field(default_factory=list)
    odd: Mapping[str, str] = field(default_factory=dict)
    clocks: tuple[str, ...] = ()
    turns: dict[str, Jumps] = field(default_factory=dict)
    attributes: dict[str, Mapping[str, Attribute]] = field(default_factory=dict)
    where: Where = field(default_factory=dict)

    @property
    def exclusions(self) -> list[str]:
        """A line for each reason to exclude demonstrations, with their names."""
        return reasons_told(self.odd, len(self.lengths), EXCLUDE)

    @property
    def notes(self) -> list[str]:
        """A line for each odd demonstration, unusual control dimension, coincidence, and kind of control."""
        auto = control_parts(ControlSpec(), self.control) if self.control else ()
        kinds = (f"{line}, by control.kind: auto" for line in described(auto))
        leaks = (f"{place} {why}" for place, why in self.leaks.items())
        target = f"the control is a target of obs/{self.relative_to}: what follows is of their difference"
        followed = [f"{target}, control.relative_to: {self.relative_to}"] if self.relative_to else []
        first = [*self.exclusions, *followed, *self.clocks, *notes(self.control)]
        return [*first, *self.coincidences, *leaks, *kinds]

    @property
    def tasks(self) -> dict[str, list[str]]:
        """The names of the demonstrations of each task, in alphabetical order; empty where none is named."""
        found = by_task({name: self.attributes[name] for name in self.lengths})
        return {task: found[task] for task in sorted(found, key=natural)} if {*found} - {""} else {}

    @property
    def several(self) -> bool:
        """Whether there are several tasks, with two demonstrations and more in the mean."""
        return are_several([task_of(self.attributes[name]) for name in self.lengths])

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
            "tasks": self.tasks,
            "control_frequency": self.frequency,
            "masks": {name: list(names) for name, names in self.masks.items()},
            "fields": [array.as_json() for array in self.fields.values()],
            "control_dimensions": [dimension.as_data() for dimension in self.control],
            "relative_to": self.relative_to,
            "odd": dict(self.odd),
            "notes": self.notes,
            "problems": self.problems,
        }


def inspect(
    path: str | Path, form: str | None = None, exclude: Sequence[str] = (), where: Where = NOTHING
) -> Inspection:
    """Read every array of a file or folder once, in blocks.

    :param exclude: names of demonstrations to skip.
    :param where: attributes and values of the demonstrations to look at; all if empty.
    :raises DemonstrationsError: the source cannot be read, or holds no demonstrations.
    """
    with open_source(path, form, where=where, exclude=exclude) as source:
        about = (Path(path), source.format, source.masks, source.frequency)
        found = Inspection(*about, excluded=tuple(exclude), where=where)
        _Inspector(source, found).read()
    return found


class _Inspector:
    """One pass over all arrays of a source, which feeds every statistic."""

    def __init__(self, source: Source, found: Inspection) -> None:
        self.source, self.found = source, found
        self.problems = defaultdict[tuple[str, str], list[str]](list)  # messages by kind and subject
        self.vectors = dict[str, dict[str, np.ndarray]]()  # controls, narrow observations, by place and name
        self.digests: dict[str, bytes] = {}
        self.traits: list[Traits] = []

    def read(self) -> None:
        """Read all demonstrations."""
        found, fields, places = self.found, self.found.fields, dict[str, Collection[str]]()
        for name in self.source.names:
            try:
                places[name] = self._read(name)
            except DemonstrationsError as error:
                kind = re.sub(r"\d+", "", str(error).removeprefix(name))
                self.problems["unreadable", kind].append(str(error))
                found.unreadable.append(name)
        for name, there in places.items():
            for place in (place for place in fields if place not in there):
                self.problems["missing", place].append(f"{name}: {place} is missing")
        try:
            for key, names in label_names(self.source.attributes).items():
                if array := fields.get(f"labels/{key}"):
                    array.names = names
        except DemonstrationsError as error:
            self.problems["names", "labels"].append(str(error))
        controls = self.vectors.get("actions", {})
        found.control = control_dimensions(controls)
        odd = unlike(self.traits) | self._odd(found.control, controls)
        found.odd = {name: odd[name] for name in found.lengths if name in odd}
        every = self.problems.values()
        kinds = (own[0] if len(own) == 1 else f"{own[0]}; the first of {len(own)} such" for own in every)
        found.problems = [*kinds, *_problems_of_division(self.source), *_problems(found)]
        self._coincidences(controls)
        found.clocks = tuple(self._clocks())

    def _coincidences(self, controls: Mapping[str, np.ndarray]) -> None:
        """What of the demonstrations coincides, and the control minus what it is a target of."""
        found = self.found
        varying = [dimension.number for dimension in found.control if not dimension.constant]
        beside = {}
        for array in found.observations:
            own = self.vectors.get(array.place, {})
            known = {name: rows for name, rows in own.items() if name in controls}
            if known:
                rows, commands = [*known.values()], [controls[name] for name in known]
                beside[array.place] = Beside(array.place, rows, commands, varying, array.constant)
            why = generated(array.place) or (beside[array.place].reason if known else "")
            found.leaks |= {array.place: why} if why else {}
        if not any(dimension.integer or len(dimension.values) == 2 for dimension in found.control):
            seen = (one for one in found.observations if found.everywhere(one) and one.place in beside)
            targets = (one.key for one in seen if one.place not in found.leaks and beside[one.place].followed)
            found.relative_to = next(targets, None)
        if (key := found.relative_to) is not None:
            less = {name: rows - self.vectors[f"obs/{key}"][name] for name, rows in controls.items()}
            found.control = control_dimensions(less)
        lines = [*copies(self.digests, found.masks)]
        for place, one in beside.items():
            lines += one.notes() if place not in (*found.leaks, f"obs/{key}") else ()
        for place, each in self.vectors.items():
            if found.fields[place].dtype.kind == "f" and (turning := jumps(each)):
                found.turns[place] = turning
                lines += turning.notes(place)
        found.coincidences = tuple(lines)

    def _clocks(self) -> Iterator[str]:
        """A line for a rate that may be a period in milliseconds, and for the first fault of each clock."""
        if (rate := self.found.frequency) and rate <= SLOWEST:
            said = f'if its dt is in milliseconds, write file.attrs["control_frequency"] = {1000 * rate:.4g}'
            yield f"a step lasts {1 / rate:.4g} s by the file: {said}"
        for place, each in self.vectors.items():
            if place.rpartition("/")[2] in CLOCKS and self.found.fields[place].minimum.shape == (1,):
                faults = ((name, clock_fault(rows[:, 0].astype(float), GAP)) for name, rows in each.items())
                yield from islice((f"{place} {fault}, in {name}" for name, fault in faults if fault), 1)

    def _odd(self, dims: Sequence[ControlDimension], controls: Mapping[str, np.ndarray]) -> dict[str, str]:
        """Names of demonstrations to exclude, and why.

        Dead ones are, and the few without which a control dimension is a switch.
        """
        if any(dim.integer for dim in dims):
            return {}
        long = {name: rows for name, rows in controls.items() if len(rows) >= FEWEST}
        still = [name for name, rows in long.items() if same(rows.min(0).astype(float), rows.max(0)).all()]
        dead = [name for name in still if not long[name].any()]
        others = [name for name in still if name not in dead]
        reasons = dict.fromkeys(dead, "all commands are 0") if 2 * len(dead) < len(self.found.lengths) else {}
        if len(others) <= most_few(len(self.found.lengths)):
            reasons |= dict.fromkeys(others, "all commands are the same")
        for dim in dims:
            why = f"control dimension {dim.number} has further values there, and is a switch elsewhere"
            reasons = {**dict.fromkeys(() if dim.values else dim.exceptions, why), **reasons}
        return reasons

    def _read(self, name: str) -> Collection[str]:
        """Read a demonstration, vectors whole and pictures in blocks; the places of its arrays."""
        demo = self.source.read(name)
        arrays = demo.arrays()
        arrays |= {place: np.asarray(array) for place, array in arrays.items() if _vector(place, array)}
        self.found.lengths[name], self.found.attributes[name] = len(demo), demo.attributes
        task, digest, vectors = task_of(demo.attributes), hashlib.sha256(), dict[str, np.ndarray]()
        for place, array in arrays.items():
            new = Field(place, array.shape[1:], array.dtype, np.zeros(0), np.zeros(0))
            field = self.found.fields.get(place, new)
            if problem := different(array, len(demo), field.shape, "the first"):
                self.problems["shape", place].append(f"{name}: {place} {problem}")
                continue
            self.found.fields[place] = field
            field.having.append(name)
            field.video = field.video or (isinstance(array, LazyArray) and array.video)
            if field.video or not field.numeric:
                continue
            step, first, label = 0, np.zeros((0, 0)), place.startswith("labels/")
            digest.update(b"" if label else place.encode())
            for block in blocks(array):
                values = block.reshape(len(block), -1)
                first = first if step else values[:1].copy()
                digest.update(b"" if label else np.ascontiguousarray(values).tobytes())
                field.add(values, name, task, step, first)
                step += len(values)
            if step and not label and isinstance(array, np.ndarray) and _vector(place, array):
                vectors[place] = array.reshape(step, -1)
        self.digests[name] = digest.digest()
        for place, rows in vectors.items():
            self.vectors.setdefault(place, {})[name] = rows
        self.traits += [traits_of(name, task, vectors)] if "actions" in vectors else []
        return arrays.keys()


def _vector(place: str, array: Observed) -> bool:
    """Whether an array is the control, or an observation of few numbers that is read whole."""
    narrow = place == "actions" or math.prod(array.shape[1:]) <= MOST_DIMENSIONS
    return array.dtype.kind in NUMBERS and narrow and not is_picture(array)


def _problems_of_division(source: Source) -> Iterator[str]:
    strangers = list(problems_of_masks(source.masks, source.names))
    yield from strangers
    if not strangers:
        try:
            check_division(source.names, source.masks)
        except DemonstrationsError as error:
            yield str(error)


def _problems(found: Inspection) -> Iterator[str]:
    for array in found.fields.values():
        if problem := array.problem:
            yield f"{array.place} {problem}"
        if array.first is not None:
            name, step = array.first
            affected, are = len(array.affected), "is" if len(array.affected) == 1 else "are"
            has = f"{array.place} has {array.unusable}, the first in {name} at step {step}"
            yield f"{has}; {affected} of {array.demonstrations} demonstrations {are} affected"
    if empty := [name for name, steps in found.lengths.items() if steps == 0]:
        yield f"{few(empty)}: no steps"
