"""Cells of a study: one fit each, with its rollouts, kept as soon as it is done.

A study's folder may be moved. It holds results (``cells/KEY.json``), fits (``work/KEY``), ``demonstrations``.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import subprocess
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import Field

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import Busy, json_text, only_one, write_text
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.sources import open_source
from ddco_pyro.data.starting import TEMPLATE, starting_spec
from ddco_pyro.errors import BadInput, reason
from ddco_pyro.evaluation.agreement import MATCHED, UNMATCHED
from ddco_pyro.events import CellDone, CellsBegan, OnEvent, ignore
from ddco_pyro.fitting.fit import fit
from ddco_pyro.inference import compile_all
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Record, read_record
from ddco_pyro.spec import Spec, parse_spec, with_overrides
from ddco_pyro.spec.yaml import read_yaml
from ddco_pyro.training import data
from ddco_pyro.training.networks import Dimensions, baseline_spec, named_baselines
from ddco_pyro.training.processes import one_thread
from studies.declaration import NATS, PARTS, Study
from studies.statistics import CELL, COLUMNS, ORIGIN, earlier

ROOT = Path(__file__).resolve().parents[1]
FAILED, RISING, DIRTY = "failed", "not converged", "-dirty"
"""Measures, 1, of cells that failed and of fits that have not converged; a commit with later changes."""


class Done(Record):
    """The results of a cell by measure, or why it failed; all that decides them, and the commit of them."""

    depends: dict[str, Any] = Field(default={})
    values: dict[str, Any] = Field(default={})
    key: str = ""
    code: str = ""
    failed: str = ""
    converged: bool = True


def kept(path: Path, depends: Mapping[str, Any] | None) -> Done | None:
    """The results in a cell's file, if they depend on the same; with None in any case."""
    if not path.exists():
        return None
    done = read_record(path, Done, "remove it and run the study again: this cell alone is done anew")
    return done if depends is None or done.depends == json.loads(json.dumps(depends)) else None


def do(
    path: Path, depends: Mapping[str, Any], work: Callable[[Path], Mapping[str, Any]], code: str = ""
) -> str:
    """Do a cell on one thread unless another process does, keep its results in ``path``; why it failed."""
    folder = path.parents[1] / "work" / path.stem
    try:
        with only_one(folder):
            before = kept(path, depends)
            if before is not None and not before.failed:  # another process has done it
                return ""
            begun = folder / "code"
            same = begun.exists() and begun.read_text(encoding="utf-8") == code
            if (path.exists() and before is None) or not same:
                shutil.rmtree(folder / "fit", ignore_errors=True)  # of other defaults or of another commit
            write_text(begun, code)
            try:
                with one_thread():
                    found = work(folder)
            except Exception as error:  # other cells go on, and the reason is shown
                found = {"failed": reason(error)}
            done = Done(depends=dict(depends), key=path.stem, code=code, **found)
            write_text(path, json_text(done.model_dump()))
            return done.failed
    except Busy:
        return ""


def do_all(calls: Mapping[str, Callable[[], str]], kept: int, workers: Workers, on_event: OnEvent) -> None:
    """Make the calls of :func:`do`, by the name of the cell; ``kept`` other cells are done already."""
    on_event(CellsBegan("study", len(calls) + kept, kept))
    with run_all(calls, workers, "did a cell") as done:
        for name, failed in done:
            on_event(CellDone(name, failed))


def commit_of(path: Path) -> str:
    """The last commit that changed library, tasks, studies or declaration; ``-dirty`` if changed since."""
    path = path.resolve()
    paths = ["ddco_pyro", "tasks", ":(glob)studies/*.py", *([str(path)] if path.is_relative_to(ROOT) else [])]

    def git(*words: str) -> str:
        command = ["git", "-C", str(ROOT), *words, "--", *paths]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("log", "-1", "--format=%H")[:10] + DIRTY * bool(git("status", "--porcelain"))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


@dataclass(frozen=True)
class Cell:
    """A fit in the test or the development: ``method`` is its name in tables, ``of`` in the declaration."""

    part: str
    task: str
    method: str
    demonstrations: int
    seed: int
    of: str = ""
    point: dict[str, Any] = field(default_factory=dict, hash=False)
    place: int = 0

    def __str__(self) -> str:
        return f"{self.task}, {self.method}, {self.demonstrations} demonstrations, seed {self.seed}"

    @property
    def row(self) -> tuple[str, ...]:
        return self.task, self.method, str(self.demonstrations), str(self.seed)


@dataclass(frozen=True)
class Job:
    """The work of a cell, for a world's own methods: demonstrations with masks ``train`` and ``valid``."""

    cell: Cell
    spec: Spec
    demos: Demonstrations
    starts: range
    folder: Path
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class State:
    """The cells of a study, and the results of those that are done or have failed."""

    cells: Sequence[Cell]
    done: Mapping[Cell, Done]
    failed: Mapping[Cell, Done]

    @property
    def missing(self) -> list[Cell]:
        return [cell for cell in self.cells if cell not in self.done and cell not in self.failed]

    @property
    def counted(self) -> dict[Cell, Done]:
        """The results of cells that have some: those that failed have what a failed cell counts."""
        return {cell: one for cell, one in {**self.done, **self.failed}.items() if one.values}


@dataclass(frozen=True)
class Folder:
    """A study and the folder of its results."""

    study: Study
    path: Path

    def cells(self, part: str, chosen: Mapping[str, dict[str, Any]] | None = None) -> list[Cell]:
        """The cells of a part, with all points of the grid or the chosen ones; by training seed first."""
        declared, block = self.study.declared, getattr(self.study.declared.seeds, part)
        return [
            Cell(
                part, task, declared.label(name, point, part), count, block.first + place, name, point, place
            )
            for place in range(block.count)
            for count in declared.demonstrations.counts
            for task in (part != "test" and declared.choose_on) or declared.tasks
            for name, method in declared.methods.items()
            for point in ([chosen[name]] if chosen else method.points)
        ]

    def state(self) -> State:
        """The state of all cells; those of the test are unknown until development has chosen the points."""
        choose = self.study.declared.choose
        state = self._state(self.cells(PARTS[choose is not None]))
        if not choose or state.missing or (state.failed and choose not in self.study.declared.failed):
            return state
        return self._state([*state.cells, *self.cells("test", self.chosen(state))])

    def _state(self, cells: Sequence[Cell]) -> State:
        known = {cell: one for cell in cells if (one := self.kept(cell))}
        codes = dict.fromkeys(one.code for one in known.values())
        if self.study.declared.pinned and len(codes) > 1:
            why = f"results are of commits {', '.join(codes)}; keep those of one"
            raise BadInput(f"{self.study.path}: pinned: {why}")
        done = {cell: one for cell, one in known.items() if not one.failed}
        failed = {cell: one for cell, one in known.items() if one.failed}
        if values := self.study.declared.failed:
            failed = {cell: one.model_copy(update={"values": values}) for cell, one in failed.items()}
        return State(cells, done, failed)

    def chosen(self, state: State) -> dict[str, dict[str, Any]]:
        """The point of each method with the highest mean over the development cells."""
        declared, scores = self.study.declared, defaultdict[str, list[float]](list)
        for cell, one in state.counted.items():
            value = one.values.get(str(declared.choose))
            scores[cell.method].append(-math.inf if value is None else value)

        def mean(name: str, point: dict[str, Any]) -> float:
            return float(np.mean(scores[declared.label(name, point, "development")]))

        methods = declared.methods.items()
        return {name: max(method.points, key=partial(mean, name)) for name, method in methods}

    def kept(self, cell: Cell) -> Done | None:
        """The results of a cell, if it is done: here, or in the declaration's tables ``kept``."""
        known, pinned = None, self.study.declared.pinned
        if (rows := self._earlier.get(cell.row)) is not None:
            values = dict(zip(rows.measure, rows.value, strict=True))
            key, code = (" ".join(dict.fromkeys(rows[column])) for column in ORIGIN)
            failed, converged = FAILED * (FAILED in values), RISING not in values
            known = Done(values=values, key=key, code=code, failed=failed, converged=converged)
        if known is None or known.failed:  # such a cell is tried again
            known = kept(self.place(cell), None if pinned else self.depends(cell)) or known
        if known and pinned and known.key != (here := self.key(cell)):
            text = f"was done with key {known.key or 'unknown'}, here is {here}"
            remedy = "go back to what was declared then, or remove its results"
            raise BadInput(f"{self.study.path}: pinned: {cell}: {text}; {remedy}")
        return known

    @cached_property
    def _earlier(self) -> dict[Any, pd.DataFrame]:
        return dict(iter(earlier(self.study).groupby(CELL)))

    def table(self, state: State) -> pd.DataFrame:
        """The declared measures of all cells, tidy."""
        rows = []
        for cell, one in state.counted.items():
            values = {measure: one.values.get(measure) for measure in self.study.declared.measures}
            values |= {FAILED: 1 if one.failed else None, RISING: None if one.converged else 1}
            named = (self.study.path.stem, *cell.row)
            rows += [(*named, *item, one.key, one.code) for item in values.items() if item[1] is not None]
        return pd.DataFrame(rows, columns=[*COLUMNS, *ORIGIN])

    def place(self, cell: Cell) -> Path:
        """The file of a cell's results."""
        return self.path / "cells" / f"{self.key(cell)}.json"

    def key(self, cell: Cell) -> str:
        """The digest of what the declaration says of a cell."""
        depends = {**self.depends(cell), "added": None}
        return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:16]

    def depends(self, cell: Cell) -> dict[str, Any]:
        """What the results of a cell depend on; ``added`` is the code's: defaults, or init's template."""
        study, method, starts = self.study, self.study.declared.methods[cell.of], self._seeds("starts", cell)
        baseline, given, added = method.baseline, study.changes(cell.of, cell.point), dict[str, Any]()
        if study.base is None:
            added = {"template": hashlib.sha256(TEMPLATE.read_bytes()).hexdigest()[:16]}
            given = {"demonstrations.leave_one_out": False, **given}  # keys of earlier results have it
        else:
            spec = with_overrides(study.base, {**given, **_placed(cell, "demonstrations.hdf5")})
            baseline = baseline and named_baselines(spec).get(baseline.kind, baseline)
            shown = {"report", "selection", "compare_with"}  # what a result does not depend on
            dumped = partial(spec.model_dump, mode="json", exclude=shown)
            given, added = (dumped(exclude_defaults=own) for own in (True, False))
        return {
            "baseline": baseline and baseline.model_dump(exclude_unset=True, mode="json"),
            "by": method.by,
            "settings": study.settings(cell.of, cell.point),
            "world": study.declared.world,
            # keys of earlier results have a supervisor
            "data": {"task": cell.task, "supervisor": None,
                     "first": self._seeds("demonstrations", cell).start,
                     "train": cell.demonstrations, "held_out": study.declared.demonstrations.held_out},
            "seed": cell.seed,
            "starts": [*starts[:1], len(starts)],
            "given": given,
            "added": added,
        }  # fmt: skip

    def _seeds(self, key: str, cell: Cell) -> range:
        """The seeds of a cell's ``demonstrations`` or ``starts``."""
        block = getattr(getattr(self.study.declared, key), cell.part, None)
        return range(0) if block is None else block.of(cell.place)  # type: ignore[no-any-return]

    def run(self, workers: Workers, on_event: OnEvent = ignore) -> State:
        """Do all cells that are not done; failed ones are tried again. Returns the state afterwards.

        :raises BadInput: the world cannot be used, or a pinned study's results would be of several commits.
        """
        self.study.world()  # or something is wrong with it
        code, state, tried = commit_of(self.study.path), self.state(), set[Cell]()
        self._check_code(code, state)
        compile_all()
        self.path.mkdir(parents=True, exist_ok=True)
        while cells := [cell for cell in state.cells if cell not in state.done and cell not in tried]:
            calls = {
                str(one): partial(do, self.place(one), self.depends(one), partial(self._measured, one), code)
                for one in cells
            }
            do_all(calls, len(state.done), workers, on_event)
            tried |= {*cells}
            state = self.state()  # development, once done, adds the cells of the test
        return state

    def _check_code(self, code: str, state: State) -> None:
        pinned, others = self.study.declared.pinned, {one.code for one in state.done.values()} - {code}
        if pinned and code.endswith(DIRTY):
            text = f"the code has changes since {code.removesuffix(DIRTY)}; commit them"
        elif pinned and others and len(state.done) < len(state.cells):
            remedy = "run it at that commit, or remove them"
            text = f"results are of commit {others.pop()}, here is {code}; {remedy}"
        else:
            return
        raise BadInput(f"{self.study.path}: pinned: {text}")

    def _measured(self, cell: Cell, folder: Path) -> dict[str, Any]:
        """The measures of a cell."""
        study, starts, world = self.study, self._seeds("starts", cell), self.study.world()
        spec, demos = self._prepared(cell, self._recorded(cell, world))
        if (by := study.declared.methods[cell.of].by) is not None:
            job = Job(cell, spec, demos, starts, folder, study.settings(cell.of, cell.point))
            return {"values": dict(world.methods[by](job))}
        fitted = fit(spec, demos, out=folder / "fit", keep=False)
        found = fitted.metrics.agreement
        values: dict[str, float | None] = {NATS: fitted.metrics.log_likelihood_per_step.valid}
        if spec.hierarchy and found and found.valid and (own := found.valid[0]):  # of the lowest level
            values |= {name: getattr(own, name) for name in UNMATCHED}
            values |= {name: getattr(own.matched_globally, name) for name in MATCHED}
        if starts:  # an outcome that does not apply to an episode is NaN
            means = pd.DataFrame(list(world.play(cell.task, fitted, starts, folder))).mean()
            values |= {str(name): None if math.isnan(mean) else mean for name, mean in means.items()}
        return {"values": values, "converged": fitted.metrics.training.converged}

    def _recorded(self, cell: Cell, world: Any) -> Path:
        """The recorded demonstrations of a task and training seed, the same for all methods and numbers."""
        own, seeds = self.study.declared.demonstrations, self._seeds("demonstrations", cell)
        count = own.held_out + max(own.counts)
        task = cell.task.replace(":", "-").replace("/", "-")
        path = self.path / "demonstrations" / f"{task}-{seeds.start}-{count}.hdf5"
        with only_one(self.path / "work" / path.stem, wait=True):
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                world.collect(cell.task, seeds, count, path)
        return path

    def _prepared(self, cell: Cell, file: Path) -> tuple[Spec, Demonstrations]:
        """The spec of a cell and its demonstrations: the file's first ones are held out, the next train."""
        study, held_out = self.study, self.study.declared.demonstrations.held_out
        with open_source(file) as source:
            names = sorted(source.names, key=natural)
        valid, rest = names[:held_out], names[held_out:]
        train, unused = rest[: cell.demonstrations], rest[cell.demonstrations :]
        if (base := study.base) is None:
            found = inspect(file, exclude=[*valid, *unused])
            facts = replace(found, excluded=(), masks={})  # no others are shown
            base = parse_spec(read_yaml(starting_spec(facts, file).text))
        placed = _placed(cell, file.relative_to(self.path).as_posix())
        spec = with_overrides(base, {**study.changes(cell.of, cell.point), **placed})
        reading = {"demonstrations.path": str(file), "demonstrations.exclude": unused}
        demos = data.demonstrations(with_overrides(spec, reading))
        demos = replace(demos, masks={"train": tuple(train), "valid": tuple(valid)})
        if (baseline := study.declared.methods[cell.of].baseline) is not None:
            bare = baseline.model_fields_set == {"kind"}
            beside = named_baselines(spec).get(baseline.kind, baseline) if bare else baseline
            spec = baseline_spec(spec, beside, Dimensions.of(demos))
            return with_overrides(spec, {"compare_with": []}), demos
        mixtures = [one.model_dump(exclude_unset=True) for one in spec.compare_with if one.kind == "mixture"]
        return with_overrides(spec, {"compare_with": mixtures if spec.hierarchy else []}), demos


def _placed(cell: Cell, path: str) -> dict[str, Any]:
    """What a spec says of a cell's data, by key path. The path is relative: the study's folder may move."""
    own = {"path": path, "exclude": [], "count": max(2, cell.demonstrations), "seed": 0}
    of_demonstrations = {f"demonstrations.{key}": value for key, value in own.items()}
    return of_demonstrations | {"training.seed": None, "seed": cell.seed}
