"""The declaration of a study: ``docs/studies.md`` says what each key is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from ddco_pyro.errors import BadInput, nearest
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED
from ddco_pyro.selection.grid import point_name
from ddco_pyro.spec import Spec, SpecError, load_spec, parse_spec
from ddco_pyro.spec.base import Count, Items, Model, Problems, Seed, Text, lines
from ddco_pyro.spec.model import Baseline
from ddco_pyro.spec.yaml import read_mapping

LINEAR = {"network": "linear"}
SKELETON = {
    "demonstrations": {"path": "none.hdf5"},
    "observations": ["none"],
    "hierarchy": {"levels": [{"count": 2, "policy": LINEAR}], "meta_policy": LINEAR},
}
"""A spec like those of ``init``, in which overrides are checked before there are demonstrations."""

ALONE: Any = {"demonstrations.hold_out_by": None, "selection.grid": {}}
"""What every method changes in the spec: a cell is one fit."""

NATS = "nats"
"""The measure that every fit has: the held-out log-likelihood in nats per step."""

PARTS = ("test", "development")
AMONG = "is not among measures; add it there"


class Block(Model):
    """``count`` numbers from ``first`` on; in ``demonstrations`` and ``starts`` for each training seed."""

    first: Seed = 0
    count: Count

    def of(self, place: int) -> range:
        """The numbers of the training seed at a place (from 0) of its block."""
        return range(self.first + place * self.count, self.first + (place + 1) * self.count)


class Blocks(Model):
    """Blocks that share no number: for the results, and for the choice among points of grids."""

    test: Block
    development: Block | None = None


class DataSpec(Blocks):
    """The demonstrations, which the world records newly for every training seed."""

    counts: Annotated[Items[Count], Field(min_length=1)]
    held_out: Count = 10


class MethodSpec(Model):
    """What one method changes in the spec; with ``by``, what the world's method of this name is told."""

    baseline: Baseline | None = None
    by: Text | None = None
    overrides: dict[str, Any] = Field(default={})
    grid: dict[str, Annotated[Items[Any], Field(min_length=1)]] = Field(default={})

    @property
    def points(self) -> list[dict[str, Any]]:
        """The points of the grid, each with values by key path."""
        return [dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())]


class ContrastSpec(Model):
    """A primary contrast: a test of the mean difference ``ours - theirs`` between two methods."""

    contrast: Text
    measure: Text
    demonstrations: Count | None = None
    kind: Literal["superiority", "non_inferiority", "equivalence"] = "superiority"
    margin: float = Field(default=0.0, ge=0)

    @property
    def bounds(self) -> tuple[float, float]:
        """Where the difference has to lie."""
        low = self.margin if self.kind == "superiority" else -self.margin
        return low, self.margin if self.kind == "equivalence" else math.inf


class KeptSpec(Model):
    """A tidy table of earlier results, whose cells are not done again; names here to those in the table."""

    table: Text
    study: Text | None = None
    tasks: dict[Text, Text] = Field(default={})
    methods: dict[Text, Text] = Field(default={})  # others of the table are not taken
    measures: dict[Text, Text] = Field(default={})


class Declaration(Model):
    """The contents of a declaration's file."""

    question: Text
    spec: Text = "init"  # what ``ddco-pyro init`` writes for the training demonstrations of each cell
    world: Text
    tasks: Annotated[Items[Text], Field(min_length=1)]
    overrides: dict[str, Any] = Field(default={})
    choose: Text | None = None
    choose_on: Items[Text] = ()
    methods: Annotated[dict[Text, MethodSpec], Field(min_length=1)]
    seeds: Blocks
    demonstrations: DataSpec
    starts: Blocks | None = None
    measures: Annotated[Items[Text], Field(min_length=1)] = (NATS,)
    contrasts: Items[ContrastSpec] = ()
    correction: Literal["holm", "fixed_sequence"] = "holm"
    families: dict[Text, Annotated[Items[Text], Field(min_length=2)]] = Field(default={})
    failed: dict[Text, float] = Field(default={})
    pinned: bool = False
    exploratory: bool = False  # contrasts were declared after the results, or tasks chose the methods
    kept: Items[KeptSpec] = ()

    def problems(self) -> Problems:
        """Blocks that overlap, what is missing, names that nothing has, and unequal tuning."""
        return ((at, text) for wrong, at, text in [*self._data(), *self._named(), *self._chosen()] if wrong)

    def ranges(self, key: str) -> dict[str, range]:
        """All numbers of the blocks of ``seeds``, ``demonstrations`` or ``starts``, by key path."""
        ranges = {}
        for part in PARTS:
            block, seeds = getattr(getattr(self, key), part, None), getattr(self.seeds, part)
            if block and seeds:
                last = 0 if key == "seeds" else seeds.count - 1
                ranges[f"{key}.{part}"] = range(block.first, block.of(last).stop)
        return ranges

    def _data(self) -> Iterator[tuple[bool, str, str]]:
        data, needed = self.demonstrations, max(self.demonstrations.counts) + self.demonstrations.held_out
        seeds, recorded, starts = map(self.ranges, ("seeds", "demonstrations", "starts"))
        for blocks in (seeds, recorded | starts):
            for (one, ours), (other, theirs) in combinations(blocks.items(), 2):
                taken = f"{one} ({ours.start} to {ours.stop - 1})"
                text = f"{theirs.start} to {theirs.stop - 1} overlaps {taken}; move one of them"
                yield ours.start < theirs.stop and theirs.start < ours.stop, other, text
        for part in (part for part in PARTS if getattr(self.seeds, part)):
            block, missing = getattr(data, part), "missing; give first and count"
            yield block is None, f"demonstrations.{part}", missing
            yield self.starts is not None and getattr(self.starts, part) is None, f"starts.{part}", missing
            few = block is not None and block.count < needed
            text = f"must be at least {needed}, the most to train on and those held out"
            yield few, f"demonstrations.{part}.count", text
        related = [task for tasks in self.families.values() for task in tasks]
        units = {*self.tasks} - {*related} | {*self.families}
        wrong = bool({*related} - {*self.tasks} or len({*related}) < len(related) or len(units) < 2)
        text = "must have tasks of the study, each once, and leave several units"
        yield bool(self.families) and wrong, "families", text

    def _named(self) -> Iterator[tuple[bool, str, str]]:
        known, counts = (NATS, *UNMATCHED, *MATCHED), self.demonstrations.counts
        for number, one in enumerate(self.measures):
            there = ", ".join(known)
            text = f"there is no measure {one!r}{nearest(one, known)}; without starts there is: {there}"
            yield self.starts is None and one not in known, f"measures.{number}", text
        for number, contrast in enumerate(self.contrasts):
            at, count = f"contrasts.{number}", contrast.demonstrations
            yield contrast.measure not in self.measures, f"{at}.measure", f"{contrast.measure!r} {AMONG}"
            for name in contrast.contrast.split(" - ", 1):
                text = f"{contrast.contrast!r}: there is no method {name!r}{nearest(name, self.methods)}"
                text = f"{text}; write 'ours - theirs' with: {', '.join(self.methods)}"
                yield name not in self.methods, f"{at}.contrast", text
            wrong = len(counts) > 1 if count is None else count not in counts
            yield wrong, f"{at}.demonstrations", f"must be one of {', '.join(map(str, counts))}"
            wrong = contrast.kind == "equivalence" and not contrast.margin
            yield wrong, f"{at}.margin", "missing; say which differences are none"
        for name, method in self.methods.items():
            both = method.by is not None and method.baseline is not None
            yield both, f"methods.{name}.baseline", "stands beside by; keep one of the two"
            for path in method.overrides.keys() & method.grid.keys():
                text = f"has {path!r}, which the grid has, too; keep one of the two"
                yield True, f"methods.{name}.overrides", text
        for name in self.failed:
            yield name not in self.measures, f"failed.{name}", f"{name!r} {AMONG}"

    def _chosen(self) -> Iterator[tuple[bool, str, str]]:
        choose, none = self.choose, self.choose is None
        together = "goes together with seeds.development; give both or neither"
        yield none != (self.seeds.development is None), "choose", together
        yield not none and choose not in self.measures, "choose", f"{choose!r} {AMONG}"
        for number, task in enumerate(self.choose_on):
            text = f"{task!r} is not among tasks, or there is nothing to choose; remove it"
            yield none or task not in self.tasks, f"choose_on.{number}", text
        points = {name: {point_name(point) for point in one.points} for name, one in self.methods.items()}
        trials = {name: len(own) for name, own in points.items()}
        text = "missing; name the measure that chooses among the points"
        yield none and {*trials.values()} != {1}, "choose", text
        counts = ", ".join(f"{name} {count}" for name, count in trials.items())
        text = f"have unequal numbers of points to choose from ({counts}); name as many for each"
        yield not none and len({*trials.values()}) > 1, "methods", text
        text = "have nothing to choose from; give each a grid"
        yield not none and {*trials.values()} == {1}, "methods", text

    def label(self, method: str, point: dict[str, Any], part: str = "test") -> str:
        """The name of a method in tables: in the development with the point of the grid."""
        return f"{method} ({point_name(point)})" if point and part != "test" else method


@dataclass(frozen=True)
class Study:
    """A declaration, its file, and the spec that it names (None for ``init``)."""

    path: Path
    declared: Declaration
    base: Spec | None

    @classmethod
    def load(cls, path: Path) -> Study:
        """Read a declaration and check the spec of every method; raises SpecError, a line per problem."""
        try:
            declared = Declaration.model_validate(read_mapping(path, "study"))
        except ValidationError as error:
            raise SpecError(*(f"{path}: {line}" for line in lines(error, Declaration))) from None
        base = None if declared.spec == "init" else load_spec(path.parent / declared.spec, (), True)
        study = cls(path, declared, base)
        given: Any = SKELETON if study.base is None else study.base.model_dump(exclude_unset=True)
        methods = declared.methods.items()
        for name, point in [(name, point) for name, method in methods for point in method.points]:
            try:
                parse_spec(given, study.changes(name, point))
            except SpecError as error:
                where = declared.label(name, point, "")
                raise SpecError(*(f"{path}: {where}: {problem}" for problem in error.problems)) from None
        return study

    def changes(self, method: str, point: dict[str, Any]) -> dict[str, Any]:
        """What a method with a point of the grid changes in the spec, by key path."""
        own, settings = {**self.declared.methods[method].overrides, **point}, self.settings(method, point)
        return {**ALONE, **self.declared.overrides, **{key: own[key] for key in own if key not in settings}}

    def settings(self, method: str, point: dict[str, Any]) -> dict[str, Any]:
        """What a world's own method is told, by name: its overrides and its point."""
        own = self.declared.methods[method]
        return {} if own.by is None else {**own.overrides, **point}

    def world(self) -> Any:
        """The simulator of the study; raises BadInput if it cannot be imported, or lacks a method."""
        try:
            world = resolve_name(f"studies.{self.declared.world}")
        except Exception as error:  # whatever the world's code raises
            raise BadInput(f"{self.path}: world: {self.declared.world} cannot be loaded: {error}") from error
        for by in (method.by for method in self.declared.methods.values()):
            if by is not None and by not in world.methods:
                text = f"{self.declared.world} has no method {by!r}{nearest(by, world.methods)}"
                raise BadInput(f"{self.path}: {text}; it has: {', '.join(world.methods)}")
        return world
