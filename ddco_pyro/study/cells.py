"""Cells of a study: one fit each, with its rollouts, kept as soon as it is done.

The folder of a study holds ``cells/KEY.json`` (the results), ``work/KEY`` (the fit) and ``demonstrations`` (recorded
episodes). A key is a digest of what the results depend on: spec, demonstrations, seeds and starts. Nothing in the
folder depends on its place, so another machine can go on with a copy.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import Busy, json_text, only_one, write_text
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.sources import open_source
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.errors import BadInput, reason
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED
from ddco_pyro.events import CellDone, CellsBegan, OnEvent, ignore
from ddco_pyro.fitting.digest import Digest, digest, recorded
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.inference import compile_all
from ddco_pyro.jobs import Workers, processes, run_all
from ddco_pyro.metrics import Record, read_record
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import run_episodes
from ddco_pyro.spec import DemonstrationsSpec, Spec, SpecError, parse_spec, with_overrides
from ddco_pyro.spec.yaml import read_yaml
from ddco_pyro.study.declaration import NATS, Study
from ddco_pyro.study.table import CELL, COLUMNS, earlier
from ddco_pyro.training import data
from ddco_pyro.training.devices import one_thread
from ddco_pyro.training.networks import Dimensions, baseline_spec, named_baselines


@dataclass(frozen=True)
class Cell:
    """One method on one task, with a number of demonstrations and a training seed.

    :param part: ``test`` or ``development``.
    :param method: its name in tables.
    :param of: its name in the declaration, and its ``point`` of the grid.
    :param place: of the training seed in its block.
    """

    part: str
    task: str
    method: str
    demonstrations: int
    seed: int
    of: str = ""
    point: Mapping[str, Any] = field(default_factory=dict, hash=False)
    place: int = 0

    def __str__(self) -> str:
        task = f"{self.task}, " if self.task else ""
        return f"{task}{self.method}, {self.demonstrations} demonstrations, seed {self.seed}"

    @property
    def row(self) -> tuple[str, str, int, int]:
        """What names the cell in a table."""
        return self.task, self.method, self.demonstrations, self.seed


@dataclass(frozen=True)
class Job:
    """The work of a cell, for an adapter's own methods.

    :param spec: the spec with the cell's overrides.
    :param demos: with the masks ``train`` and ``valid``.
    :param starts: seeds of initial states.
    :param folder: keeps files of the fit.
    :param settings: of the method, by name.
    """

    cell: Cell
    spec: Spec
    demos: Demonstrations
    starts: range
    folder: Path
    settings: Mapping[str, Any]


class World(Protocol):
    """The adapter of a simulator.

    :param methods: own methods by name; each trains and acts, and gives measures of its own.
    """

    methods: Mapping[str, Any]

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Write ``count`` demonstrations of episodes from these seeds into an HDF5 file, whole or not at all.

        :raises Failed: the simulator cannot be used, or too few episodes succeed.
        """

    def play(self, task: str, fitted: Fit, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """The outcome of an episode from each start, such as ``{"success": 1.0}``."""


class Done(Record):
    """The results of a cell, as its file has them.

    :param depends: what the key is a digest of.
    :param values: by measure; empty where the cell failed for the reason ``failed``.
    """

    depends: dict[str, Any]
    values: dict[str, Any]
    failed: str = ""
    converged: bool = True
    seconds: float = 0.0


def kept(path: Path, depends: Mapping[str, Any]) -> Done | None:
    """The results in a cell's file, if they depend on the same.

    :raises Damaged: the file is damaged.
    """
    if not path.exists():
        return None
    done = read_record(path, Done, "remove it and run the study again: this cell alone is done anew")
    return done if _agrees(done.depends, _as_json(depends)) else None


def work_of(path: Path) -> Path:
    """The folder with the fits of the cell whose results are in ``path``."""
    return path.parents[1] / "work" / path.stem


def do(path: Path, depends: Mapping[str, Any], work: Callable[[Path], Mapping[str, Any]], **named: Any) -> str:
    """Do a cell on one thread and keep its results; returns why it failed.

    A cell that another process works on is left to it.

    :param path: of its file.
    :param work: fields of :class:`Done`; given a folder, which keeps the fits.
    :param named: what its file says besides.
    """
    began = time.perf_counter()
    try:
        with only_one(folder := work_of(path)):
            if (before := kept(path, depends)) is not None and not before.failed:  # another process has done it
                return ""
            if path.exists() and before is None:  # of other defaults
                shutil.rmtree(folder / "fit", ignore_errors=True)
            done = Done(depends=dict(depends), values={})
            try:
                with one_thread():
                    done = done.model_copy(update=dict(work(folder)))
            except Exception as error:  # other cells go on, and the reason is shown
                done = done.model_copy(update={"failed": reason(error)})
            done = done.model_copy(update={"seconds": time.perf_counter() - began})
            write_text(path, json_text({**named, **done.model_dump()}))
            return done.failed
    except Busy:
        return ""


def do_all(calls: Mapping[str, Callable[[], str]], kept: int, workers: Workers, on_event: OnEvent = ignore) -> None:
    """Make the calls of :func:`do`, some at a time.

    :param calls: by the name of the cell.
    :param kept: how many other cells there are, which are done.
    :raises Failed: a process died.
    """
    on_event(CellsBegan("study", len(calls) + kept, kept))
    with run_all(calls, workers, "did a cell") as done:
        for name, failed in done:
            on_event(CellDone(name, failed))


@dataclass(frozen=True)
class State:
    """The cells of a study, those of them that are done, and the reasons of those that failed."""

    cells: Sequence[Cell]
    done: Mapping[Cell, Done]
    failed: Mapping[Cell, str]

    @property
    def missing(self) -> list[Cell]:
        """The cells that are neither done nor failed."""
        return [cell for cell in self.cells if cell not in self.done and cell not in self.failed]


@dataclass(frozen=True)
class Folder:
    """A study and the folder of its results."""

    study: Study
    path: Path

    # --- what there is ------------------------------------------------------------------------------------------------

    def cells(self, part: str, chosen: Mapping[str, Mapping[str, Any]] | None = None) -> list[Cell]:
        """The cells of a part: all of a training seed before another one.

        :param chosen: the point of the grid of each method; None for all points.
        """
        declared, block = self.study.declared, getattr(self.study.declared.seeds, part)
        tasks = self.study.tasks if part == "test" else declared.choose_on or self.study.tasks
        return [
            Cell(part, task, declared.label(method, point, part), count, block.first + place, method, point, place)
            for place in range(block.count)
            for count in declared.demonstrations.counts
            for task in tasks
            for method in declared.methods
            for point in ([dict(chosen[method])] if chosen else declared.points(method))
        ]

    def state(self) -> State:
        """The state of all cells; those of the test are unknown until development has chosen the points.

        :raises Damaged: the file of a cell is damaged.
        """
        state = self._state(self.cells(self.first))
        if self.first == "test" or len(state.done) < len(state.cells):
            return state
        return self._state([*state.cells, *self.cells("test", self.chosen(state))])

    @property
    def first(self) -> str:
        """The part that is done first."""
        return "development" if self.study.declared.choose else "test"

    def _state(self, cells: Sequence[Cell]) -> State:
        found = {cell: one for cell in cells if (one := self.kept(cell))}
        failed = {cell: one.failed for cell, one in found.items() if one.failed}
        return State(cells, {cell: one for cell, one in found.items() if not one.failed}, failed)

    def chosen(self, state: State) -> dict[str, dict[str, Any]]:
        """The point of each method with the highest mean over the development cells."""
        rows = [
            (cell.of, json.dumps(cell.point), done.values.get(str(self.study.declared.choose)))
            for cell, done in state.done.items()
            if cell.part == "development"
        ]
        scores = pd.DataFrame(rows, columns=["of", "point", "value"]).fillna(-math.inf)
        means = scores.groupby(["of", "point"], sort=False).value.mean()
        return {str(of): json.loads(own.idxmax()[1]) for of, own in means.groupby("of")}

    def kept(self, cell: Cell) -> Done | None:
        """The results of a cell, if it is done: here, or in the declaration's table ``kept``."""
        if values := self._earlier.get(tuple(map(str, cell.row))):
            return Done(depends={}, values=values)
        return kept(self.place(cell), self.depends(cell))

    @cached_property
    def _earlier(self) -> dict[tuple[str, ...], dict[str, float | None]]:
        """The values of the declaration's tables ``kept``, by cell and measure."""
        by_cell = earlier(self.study).groupby(CELL)
        return {cell: dict(zip(rows.measure, rows.value, strict=True)) for cell, rows in by_cell}

    def table(self, state: State) -> pd.DataFrame:
        """The declared measures of all cells that are done, tidy; methods of the development name their points."""
        rows = [
            (self.study.name, *map(str, cell.row), measure, value)
            for cell, done in state.done.items()
            for measure in self.study.declared.measures
            if (value := done.values.get(measure)) is not None
        ]
        return pd.DataFrame(rows, columns=COLUMNS)

    # --- keys ---------------------------------------------------------------------------------------------------------

    def place(self, cell: Cell) -> Path:
        """The file of a cell's results."""
        return self.path / "cells" / f"{self.key(cell)}.json"

    def key(self, cell: Cell) -> str:
        """The digest of what a cell depends on; settings that are defaults do not count."""
        depends = {key: value for key, value in self.depends(cell).items() if key != "spec"}
        return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:16]

    def depends(self, cell: Cell) -> dict[str, Any]:
        """What the results of a cell depend on: ``given`` without defaults, and ``spec`` with them."""
        declared, method = self.study.declared, self.study.declared.methods[cell.of]
        baseline, changes, starts = method.baseline, self.study.changes(cell.of, dict(cell.point)), self._starts(cell)
        given, whole = changes, dict[str, Any]()
        if self.study.base is not None:
            spec = with_overrides(self.study.base, {**changes, **self._placed(cell, "demonstrations.hdf5")})
            baseline = baseline and named_baselines(spec).get(baseline.name, baseline)
            shown = {"report", "selection", "compare_with"}  # what a result does not depend on
            given, whole = (
                spec.model_dump(mode="json", exclude=shown, exclude_defaults=bare) for bare in (True, False)
            )
        facts = {
            "baseline": baseline and baseline.model_dump(exclude_unset=True, mode="json"),
            "by": method.by,
            **({"settings": settings} if (settings := self.study.settings(cell.of, dict(cell.point))) else {}),
            "world": declared.world,
            "data": self._drawn(cell),
            "seed": cell.seed,
            "starts": [*starts[:1], len(starts)],
        }
        return _as_json({**facts, "given": given, "spec": whole})

    def _starts(self, cell: Cell) -> range:
        starts = self.study.declared.starts
        return range(0) if starts is None else getattr(starts, cell.part).of(cell.place)  # type: ignore[no-any-return]

    def _drawn(self, cell: Cell) -> dict[str, Any]:
        """The demonstrations of a cell: how they are recorded, or their digest and the names that are drawn."""
        own = self.study.declared.demonstrations
        if self.study.source is None:
            first = getattr(own, cell.part).of(cell.place).start
            return {"task": cell.task, "supervisor": own.supervisor, "first": first, "train": cell.demonstrations,
                    "held_out": own.held_out}  # fmt: skip
        train, valid = self._divided(cell)
        found = self._digest
        return {"names": [train, valid], "actions": found.controls, "obs": found.observations, "labels": found.labels}

    @cached_property
    def _digest(self) -> Digest:
        """The digest of the file of demonstrations; pictures are read once."""
        assert self.study.source is not None  # or there is nothing to digest
        known = recorded(self.path)
        found = digest(Demonstrations.read(self.study.source), known)
        if known != found and self.path.exists():
            write_text(self.path / "demonstrations.json", found.model_dump_json(indent=1) + "\n")
        return found

    @cached_property
    def _names(self) -> list[str]:
        """The demonstrations in the study's file, in natural order."""
        assert self.study.source is not None  # or they are recorded
        with open_source(self.study.source) as source:
            return sorted(source.names, key=natural)

    def _divided(self, cell: Cell, names: Sequence[str] | None = None) -> tuple[list[str], list[str]]:
        """The names of the training and of the held-out demonstrations of a cell.

        From a study's file they are drawn by the training seed; recorded ones are taken in their order. A seed's
        demonstrations are among those that the seed has where there are more of them.

        :param names: of recorded demonstrations.
        :raises BadInput: there are too few demonstrations.
        """
        own, count = self.study.declared.demonstrations, cell.demonstrations
        held_out = own.held_out
        if names is None:
            block = getattr(own, cell.part)
            there = self._names if block is None else self._names[block.first : block.first + block.count]
            if len(there) < held_out + max(own.counts):
                raise BadInput(
                    f"{self.study.source}: has {len(there)} demonstrations for {cell.part}, but the study needs "
                    f"{held_out + max(own.counts)}; lower demonstrations.counts or held_out"
                )
            names = [there[n] for n in np.random.default_rng(cell.seed).permutation(len(there))]
        train, valid = names[held_out : held_out + count], names[:held_out]
        return sorted(train, key=natural), sorted(valid, key=natural)

    # --- the work -----------------------------------------------------------------------------------------------------

    def run(self, workers: Workers, on_event: OnEvent = ignore) -> State:
        """Do all cells that are not done; failed ones are tried again. Returns the state afterwards.

        :raises BadInput: the file of demonstrations, the adapter or a task cannot be used.
        :raises Failed: a process died.
        """
        self.study.world()  # or something is wrong with it
        compile_all()
        self.path.mkdir(parents=True, exist_ok=True)
        cells, state = self.cells(self.first), None
        there = Folder(replace(self.study, path=self.study.path.resolve()), self.path.resolve())  # wherever workers are
        with processes(workers.number(len(cells))):
            while state is None or len(cells) > len(state.cells):
                done = self._state(cells).done
                calls = {str(cell): partial(there.do, cell) for cell in cells if cell not in done}
                do_all(calls, len(done), workers, on_event)
                state = self._state(cells)
                cells = list(self.state().cells)  # development, once done, adds those of the test
        return state

    def do(self, cell: Cell) -> str:
        """Do a cell, as :func:`do` does."""
        return do(self.place(cell), self.depends(cell), partial(self._measured, cell), cell=asdict(cell))

    def _measured(self, cell: Cell, folder: Path) -> dict[str, Any]:
        """The measures of a cell."""
        world, method = self.study.world(), self.study.declared.methods[cell.of]
        spec, demos = self._prepared(cell, world)
        starts = self._starts(cell)
        if method.by is not None:
            job = Job(cell, spec, demos, starts, folder, self.study.settings(cell.of, dict(cell.point)))
            return {"values": dict(world.methods[method.by](job))}
        fitted = fit(spec, demos, out=folder / "fit", keep=False)
        found = fitted.metrics.agreement
        values: dict[str, float | None] = {NATS: fitted.metrics.log_likelihood_per_step.valid}
        if spec.hierarchy and found and found.valid and (own := found.valid[0]):  # of the lowest level
            values |= {name: getattr(own, name) for name in UNMATCHED}
            values |= {name: getattr(own.matched_globally, name) for name in MATCHED}
        if starts:
            if world is not None:
                played = world.play(cell.task, fitted, starts, folder)
            else:
                episodes = run_episodes(cell.task, fitted.controller(), starts, 0, 1, spec.observed, ())
                played = [episode.outcome for episode in episodes]
            values |= {name: _mean([one[name] for one in played]) for name in played[0]}
        return {"values": values, "converged": fitted.metrics.training.converged}

    def _prepared(self, cell: Cell, world: World | None) -> tuple[Spec, Demonstrations]:
        """The spec of a cell and its demonstrations, which are recorded first where they are not there."""
        study, own = self.study, self.study.declared.demonstrations
        file = study.source or self._recorded(cell, world)
        with open_source(file) as source:
            names = sorted(source.names, key=natural)
        train, valid = self._divided(cell, None if study.source else names)
        unused = [name for name in names if name not in {*train, *valid}]
        base = study.base
        if base is None:
            facts = replace(inspect(file, exclude=[*valid, *unused]), excluded=(), masks={})  # no others are shown
            base = parse_spec(read_yaml(starting_spec(facts, file).text))
        placed = self._placed(cell, own.path or file.relative_to(self.path).as_posix())
        spec = with_overrides(base, {**study.changes(cell.of, dict(cell.point)), **placed})
        reading = {"demonstrations.path": str(file), "demonstrations.exclude": unused}
        demos = data.demonstrations(with_overrides(spec, reading))
        demos = replace(demos, masks={"train": tuple(train), "valid": tuple(valid)})
        if (baseline := study.declared.methods[cell.of].baseline) is not None:
            bare = baseline.model_fields_set == {"kind"}
            beside = named_baselines(spec).get(baseline.name, baseline) if bare else baseline
            try:
                spec = baseline_spec(spec, beside, Dimensions.of(demos))
            except SpecError as error:
                raise SpecError(*(f"methods.{cell.of}.{problem}" for problem in error.problems)) from error
        return with_overrides(spec, {"compare_with": []}), demos

    def _placed(self, cell: Cell, path: str) -> dict[str, Any]:
        """What a spec says of a cell's data, by key path. The path is relative: the study's folder may move."""
        task = cell.task if self.study.declared.world is None else None
        own = {"path": path, "exclude": [], "count": max(2, cell.demonstrations), "seed": 0}
        changes: dict[str, Any] = {f"demonstrations.{key}": value for key, value in own.items()}
        return changes | {"training.seed": None, "seed": cell.seed} | ({"task": task} if task else {})

    def _recorded(self, cell: Cell, world: World | None) -> Path:
        """The recorded demonstrations of a task and training seed, the same for all methods and numbers."""
        own = self.study.declared.demonstrations
        seeds, count = getattr(own, cell.part).of(cell.place), own.held_out + max(own.counts)
        path = self.path / "demonstrations" / f"{cell.task.replace(':', '-')}-{seeds.start}-{count}.hdf5"
        if world is None:
            base = self.study.base
            wanted, observed = (base.demonstrations, base.observed) if base else (DemonstrationsSpec(), [])
            how = {"count": count, "seed": seeds.start, "supervisor": own.supervisor or wanted.supervisor}
            return collect(wanted.task or cell.task, wanted.model_copy(update=how), path, observed=observed)
        with only_one(self.path / "work" / path.stem, wait=True):
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                world.collect(cell.task, seeds, count, path)
        return path


def _mean(values: Sequence[float]) -> float | None:
    """The mean over episodes of a measure that does not apply (NaN) to some."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else None


def _as_json(data: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data as they are read back from a file."""
    return dict(json.loads(json.dumps(data)))


def _agrees(kept: Any, now: Any) -> bool:
    """Whether plain data are equal, except for keys that one of them lacks: settings that came with a later version."""
    if isinstance(kept, dict) and isinstance(now, dict):
        return all(_agrees(kept[key], now[key]) for key in kept.keys() & now.keys())
    return bool(kept == now)
