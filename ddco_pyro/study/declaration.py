"""The declaration of a study: methods, data, blocks of seeds, measures, and the contrasts that decide.

A block of ``seeds`` has the training seeds. Each of them has demonstrations and starts of its own, which follow one
another in the blocks of ``demonstrations`` and ``starts``. Blocks that overlap are refused.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED
from ddco_pyro.selection.grid import point_name
from ddco_pyro.simulation.task import find_task
from ddco_pyro.spec import Spec, SpecError, load_spec, parse_spec, user_code
from ddco_pyro.spec.base import Count, Importable, Items, Model, Problems, Seed, TaskName, Text, lines
from ddco_pyro.spec.model import Baseline
from ddco_pyro.spec.yaml import read_mapping

INIT = "init"
"""The ``spec`` that stands for what ``ddco-pyro init`` writes for the training demonstrations of each cell."""

SKELETON = {
    "demonstrations": {"path": "none.hdf5"},
    "observations": ["none"],
    "hierarchy": {"levels": [{"count": 2, "policy": {"network": "linear"}}], "meta_policy": {"network": "linear"}},
}
"""A spec like those of ``init``, in which overrides are checked before there are demonstrations."""

NATS = "nats"
"""The measure that every fit has: the held-out log-likelihood in nats per step."""

PARTS = ("test", "development")


class Block(Model):
    """``count`` numbers from ``first`` on."""

    first: Seed = 0
    """The first number."""
    count: Count
    """How many numbers; in ``demonstrations`` and ``starts`` for each training seed."""

    def of(self, place: int) -> range:
        """The numbers of the training seed at a place (from 0) of its block."""
        first = self.first + place * self.count
        return range(first, first + self.count)


class Blocks(Model):
    """Blocks that share no number."""

    test: Block
    """For the results of the study."""
    development: Block | None = None
    """For the choice among points of the grid; null: nothing is chosen."""


class DataSpec(Model):
    """The demonstrations of a study."""

    path: Text | None = None
    """HDF5 file, relative to the declaration; null: every training seed has newly recorded demonstrations."""
    counts: Annotated[Items[Count], Field(min_length=1)]
    """Numbers of demonstrations to train on."""
    held_out: Count = 10
    """Further demonstrations, which score the fits."""
    supervisor: Text | None = None
    """Which of a task's scripted policies is recorded; null: that of the spec."""
    test: Block | None = None
    """Seeds of recorded episodes for each training seed. With ``path``: places in the file, from which every training
    seed draws; null: the whole file."""
    development: Block | None = None
    """The same for the choice among points of the grid."""


Grid = dict[str, Annotated[Items[Any], Field(min_length=1)]]
"""Key path in the spec to values, of which every combination is a point."""


class MethodSpec(Model):
    """What one method changes in the spec."""

    baseline: Baseline | None = None
    """A baseline in place of the hierarchy; a bare name takes the settings of the spec's ``compare_with``."""
    by: Text | None = None
    """Name of a method of the simulator's adapter, which trains and acts instead; null: the spec is fitted."""
    overrides: dict[str, Any] = Field(default={})
    """Key path in the spec to a value; with ``by``, a setting of the adapter's method to a value."""
    grid: Grid = Field(default={})
    """The same to values, beside those of the study's grid."""


class ContrastSpec(Model):
    """A primary contrast: a one-sided test of the mean difference between two methods."""

    contrast: Text
    """``ours - theirs``, names of methods."""
    measure: Text
    """The measure, of which more is better."""
    demonstrations: Count | None = None
    """The number of demonstrations; null: the only one there is."""
    kind: Literal["superiority", "non_inferiority"] = "superiority"
    """``superiority``: the difference exceeds ``margin``. ``non_inferiority``: it exceeds −``margin``."""
    margin: float = Field(default=0.0, ge=0)
    """The margin, in units of the measure."""

    @property
    def pair(self) -> tuple[str, str]:
        """The names of both methods."""
        ours, _, theirs = self.contrast.partition(" - ")
        return ours.strip(), theirs.strip()

    @property
    def bound(self) -> float:
        """The bound that the difference has to exceed."""
        return self.margin if self.kind == "superiority" else -self.margin


class KeptSpec(Model):
    """A tidy table of earlier results, whose cells are not done again. Names that are left out are equal in both."""

    table: Text
    """The table, relative to the declaration."""
    study: Text | None = None
    """The study in the table; null: all."""
    tasks: dict[Text, Text] = Field(default={})
    """The name of a task here to its name in the table."""
    methods: dict[Text, Text] = Field(default={})
    """The name of a method here to its name in the table; others of the table are not taken."""
    measures: dict[Text, Text] = Field(default={})
    """The name of a measure here to its name in the table."""


class Declaration(Model):
    """The contents of a declaration's file."""

    question: Text
    """What the study asks, in one sentence."""
    spec: Text = INIT
    """A spec's file, relative to the declaration; ``init``: what ``ddco-pyro init`` writes for the demonstrations."""
    world: Annotated[Text, Importable()] | None = None
    """Adapter of a simulator, ``module:name`` of a file beside the declaration; null: the registered tasks."""
    tasks: Items[TaskName] = ()
    """Tasks; empty: the spec's task, or none for a file of demonstrations."""
    overrides: dict[str, Any] = Field(default={})
    """Key path in the spec to a value, for every method."""
    grid: Grid = Field(default={})
    """Key path in the spec to values; every method is fitted with every combination."""
    choose: Text | None = None
    """The measure by whose mean over the development seeds each method's point of its grid is chosen, among as many for
    every method; null: every point is a method of its own."""
    choose_on: Items[TaskName] = ()
    """The tasks of the development seeds, some of ``tasks``; empty: all."""
    methods: Annotated[dict[Text, MethodSpec], Field(min_length=1)]
    """The methods by name."""
    seeds: Blocks
    """Training seeds."""
    demonstrations: DataSpec
    """The demonstrations."""
    starts: Blocks | None = None
    """Seeds of initial states, in which every method acts, for each training seed; null: nothing acts."""
    measures: Annotated[Items[Text], Field(min_length=1)] = (NATS,)
    """Measures of the tables: ``nats``, ``nmi`` and others of ``ddco_pyro.metrics.Scores``, or a task's."""
    contrasts: Items[ContrastSpec] = ()
    """The primary contrasts, whose p-values are corrected for their number."""
    kept: Items[KeptSpec] = ()
    """Tables of earlier results, the first of which decides where several have a value."""

    def problems(self) -> Problems:
        """Blocks that overlap, what is missing, names that nothing has, and unequal tuning."""
        return itertools.chain(self._blocks(), self._data(), self._measured(), self._named(), self._chosen())

    def ranges(self, key: str) -> dict[str, range]:
        """All numbers of the blocks of ``seeds``, ``demonstrations`` or ``starts``, by key path."""
        once = key == "seeds" or (key == "demonstrations" and self.demonstrations.path is not None)
        ranges = {}
        for part in PARTS:
            block, seeds = getattr(getattr(self, key), part, None), getattr(self.seeds, part)
            if block is not None and seeds is not None:
                stop = block.first + block.count * (1 if once else seeds.count)
                ranges[f"{key}.{part}"] = range(block.first, stop)
        return ranges

    def _blocks(self) -> Iterator[tuple[str, str]]:
        seeds, data, starts = map(self.ranges, ("seeds", "demonstrations", "starts"))
        recorded = self.demonstrations.path is None  # of episodes, as starts are
        for blocks in (seeds, data | starts) if recorded else (seeds, data, starts):
            for (one, ours), (other, theirs) in itertools.combinations(blocks.items(), 2):
                if ours.start < theirs.stop and theirs.start < ours.stop:
                    taken = f"{one} ({ours.start} to {ours.stop - 1})"
                    yield other, f"{theirs.start} to {theirs.stop - 1} overlaps {taken}; move one of them"

    def _data(self) -> Iterator[tuple[str, str]]:
        data, needed = self.demonstrations, max(self.demonstrations.counts) + self.demonstrations.held_out
        for part in PARTS:
            if getattr(self.seeds, part) is None:
                continue
            block, at = getattr(data, part), f"demonstrations.{part}"
            if block is None and (data.path is None or data.development is not None):
                yield at, "missing; give first and count"
            if block is not None and block.count < needed:
                yield f"{at}.count", f"must be at least {needed}, the most to train on and those held out"
            if self.starts is not None and getattr(self.starts, part) is None:
                yield f"starts.{part}", "missing; give first and count"
        if data.path is not None and len(self.tasks) > 1:
            yield "tasks", "are several, but demonstrations.path names one file; name one task"
        if self.world is not None and not self.tasks:
            yield "tasks", "missing; name tasks of the world"

    def _measured(self) -> Iterator[tuple[str, str]]:
        known = (NATS, *UNMATCHED, *MATCHED)
        for number, measure in enumerate(self.measures):
            if self.starts is None and measure not in known:
                text = f"there is no measure {measure!r}{nearest(measure, known)}; without starts there is: "
                yield f"measures.{number}", text + ", ".join(known)
        for number, contrast in enumerate(self.contrasts):
            if contrast.measure not in self.measures:
                yield f"contrasts.{number}.measure", f"{contrast.measure!r} is not among measures; add it there"
        if self.choose is not None and self.choose not in self.measures:
            yield "choose", f"{self.choose!r} is not among measures; add it there"

    def _named(self) -> Iterator[tuple[str, str]]:
        known, counts = self.labels, self.demonstrations.counts
        for number, contrast in enumerate(self.contrasts):
            for name in contrast.pair:
                if name not in known:
                    text = f"{contrast.contrast!r}: there is no method {name!r}{nearest(name, known)}"
                    yield f"contrasts.{number}.contrast", f"{text}; write 'ours - theirs' with: {', '.join(known)}"
            count = contrast.demonstrations
            if (count is None and len(counts) > 1) or (count is not None and count not in counts):
                yield f"contrasts.{number}.demonstrations", f"must be one of {', '.join(map(str, counts))}"
        for name, method in self.methods.items():
            if method.by is not None and self.world is None:
                yield f"methods.{name}.by", "names a method of an adapter; give its world"
            if method.by is not None and method.baseline is not None:
                yield f"methods.{name}.baseline", "stands beside by; keep one of the two"
            for path in method.overrides.keys() & (self.grid.keys() | method.grid.keys()):
                yield f"methods.{name}.overrides", f"has {path!r}, which the grid has, too; keep one of the two"

    def _chosen(self) -> Iterator[tuple[str, str]]:
        if (self.choose is None) != (self.seeds.development is None):
            yield "choose", "goes together with seeds.development; give both or neither"
        for number, task in enumerate(self.choose_on):
            if self.choose is None or task not in self.tasks:
                yield f"choose_on.{number}", f"{task!r} is not among tasks, or there is nothing to choose; remove it"
        trials = {name: len({point_name(point) for point in self.points(name)}) for name in self.methods}
        if self.choose is not None and len({*trials.values()}) > 1:
            counts = ", ".join(f"{name} {count}" for name, count in trials.items())
            yield "methods", f"have unequal numbers of points to choose from ({counts}); name as many for each"
        elif self.choose is not None and max(trials.values()) == 1:
            yield "grid", "is empty; name what to choose from"

    def points(self, method: str) -> list[dict[str, Any]]:
        """The points of a method's grid, each with values by key path."""
        grid = self.grid | self.methods[method].grid
        return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]

    def label(self, method: str, point: dict[str, Any], part: str = "test") -> str:
        """The name of a method in tables: with the point of the grid, unless it was chosen."""
        return f"{method} ({point_name(point)})" if point and (self.choose is None or part != "test") else method

    @property
    def labels(self) -> list[str]:
        """The names of all methods in the tables of the test."""
        return list(dict.fromkeys(self.label(name, point) for name in self.methods for point in self.points(name)))


@dataclass(frozen=True)
class Study:
    """A declaration, its file, and the spec that it names (None for ``init``).

    >>> study = Study.load("study.yaml")
    >>> study.name, list(study.declared.methods)
    ('study', ['options', 'flat'])
    """

    path: Path
    declared: Declaration
    base: Spec | None

    @classmethod
    def load(cls, path: str | Path, allow_code: bool = False) -> Study:
        """Read a declaration and check the spec of every method.

        :param allow_code: whether adapter, spec and tasks may be user code (``module:name``).
        :raises SpecError: the declaration or a spec is invalid, or names code that is not allowed; one line for each
            problem.
        """
        path = Path(path)
        data = read_mapping(path, "study")
        try:
            declared = Declaration.model_validate(data)
        except ValidationError as error:
            raise SpecError(*(f"{path}: {line}" for line in lines(error, Declaration))) from None
        base = None if declared.spec == INIT else load_spec(path.parent / declared.spec, (), allow_code)
        study = cls(path, declared, base)
        if not study.tasks[0] and (declared.starts or declared.demonstrations.path is None):
            where = "the task in which methods act" if declared.starts else "tasks, or a file in demonstrations.path"
            raise SpecError(f"{path}: tasks: missing; name {where}")
        code = user_code(declared) | {f"tasks.{n}": task for n, task in enumerate(declared.tasks) if ":" in task}
        code |= {f"overrides of {where}": name for where, name in study.overridden_code().items()}
        if code and not allow_code:
            text = "pass --allow-code if you trust it"
            raise SpecError(*(f"{path}: {at}: would import user code ({name}); {text}" for at, name in code.items()))
        return study

    @property
    def name(self) -> str:
        """The name of the study, from its file."""
        return self.path.stem

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks; an empty name stands for a file of demonstrations without a task."""
        return self.declared.tasks or ((self.base.task if self.base else None) or "",)

    def changes(self, method: str, point: dict[str, Any]) -> dict[str, Any]:
        """What a method with a point of the grid changes in the spec, by key path."""
        alone: dict[str, Any] = {
            "demonstrations.leave_one_out": False,
            "demonstrations.hold_out_by": None,
            "selection.grid": {},
        }
        own, settings = {**self.declared.methods[method].overrides, **point}, self.settings(method, point)
        return {**alone, **self.declared.overrides, **{key: own[key] for key in own if key not in settings}}

    def settings(self, method: str, point: dict[str, Any]) -> dict[str, Any]:
        """What an adapter's own method is told, by name: its overrides and its part of a point."""
        own = self.declared.methods[method]
        return {} if own.by is None else {**own.overrides, **{key: point[key] for key in own.grid}}

    def overridden_code(self) -> dict[str, str]:
        """The user code that the spec of a method names, by method.

        :raises SpecError: the overrides of a method do not fit the spec.
        """
        given: Any = SKELETON if self.base is None else self.base.model_dump(exclude_unset=True)
        named: dict[str, str] = {}
        for method, point in [(name, one) for name in self.declared.methods for one in self.declared.points(name)]:
            where = self.declared.label(method, point, "")
            try:
                spec = parse_spec(given, self.changes(method, point))
            except SpecError as error:
                raise SpecError(*(f"{self.path}: {where}: {problem}" for problem in error.problems)) from None
            if code := user_code(spec):
                named[where] = ", ".join(code.values())
        return named

    @cached_property
    def source(self) -> Path | None:
        """The file of demonstrations, where the declaration names one."""
        named = self.declared.demonstrations.path
        return None if named is None else self.path.parent / named

    def world(self) -> Any:
        """The adapter of the simulator (:class:`ddco_pyro.study.cells.World`); None for the registered tasks.

        :raises BadInput: the adapter or a task cannot be imported, or the adapter lacks a method.
        """
        if self.declared.world is None:
            for task in self.tasks if self.declared.starts or self.source is None else ():
                find_task(task)
            return None
        folder = str(self.path.parent.resolve())
        if folder not in sys.path:
            sys.path.append(folder)
        try:
            world = resolve_name(self.declared.world)
        except Exception as error:  # whatever the adapter's code raises
            raise BadInput(f"{self.path}: world: {self.declared.world} cannot be loaded: {error}") from error
        for method in self.declared.methods.values():
            if method.by is not None and method.by not in world.methods:
                text = f"{self.declared.world} has no method {method.by!r}{nearest(method.by, world.methods)}"
                raise BadInput(f"{self.path}: {text}; it has: {', '.join(world.methods)}")
        return world
