"""Cells of a study: one fit each, with its rollouts, kept as soon as it is done.

The folder of a study holds ``cells/KEY.json`` (the results), ``work/KEY`` (the fit) and ``demonstrations`` (recorded
episodes). A key is a digest of what the declaration says of the cell. Nothing in the folder depends on its place, so
another machine can go on with a copy.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

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
from ddco_pyro.fitting.digest import Digest, digest, recorded
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.inference import compile_all
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Record, read_record
from ddco_pyro.simulation.collect import collect
from ddco_pyro.simulation.episodes import run_episodes
from ddco_pyro.spec import DemonstrationsSpec, Spec, SpecError, parse_spec, with_overrides
from ddco_pyro.spec.yaml import read_yaml
from ddco_pyro.study.declaration import NATS, PARTS, Study
from ddco_pyro.study.table import CELL, COLUMNS, ORIGIN, earlier
from ddco_pyro.training import data
from ddco_pyro.training.devices import one_thread
from ddco_pyro.training.networks import Dimensions, baseline_spec, named_baselines

FAILED, RISING, DIRTY = "failed", "not converged", "-dirty"
"""Measures, 1, of cells that failed and of fits that have not converged; a commit with later changes."""


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
    point: dict[str, Any] = field(default_factory=dict, hash=False)
    place: int = 0

    def __str__(self) -> str:
        task = f"{self.task}, " if self.task else ""
        return f"{task}{self.method}, {self.demonstrations} demonstrations, seed {self.seed}"

    @property
    def row(self) -> tuple[str, ...]:
        """What names the cell in a table."""
        return self.task, self.method, str(self.demonstrations), str(self.seed)


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

    methods: Mapping[str, Callable[[Job], Mapping[str, float]]]

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Write ``count`` demonstrations of episodes from these seeds into an HDF5 file, whole or not at all.

        :raises Failed: the simulator cannot be used, or too few episodes succeed.
        """

    def play(self, task: str, fitted: Fit, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """The outcome of an episode from each start, such as ``{"success": 1.0}``."""


class Done(Record):
    """The results of a cell, as its file has them.

    :param depends: what they depend on; the ``key`` is a digest of the declaration's part.
    :param values: by measure; empty where the cell failed for the reason ``failed``.
    :param code: the commit of the code that gave them.
    """

    depends: dict[str, Any] = Field(default={})
    values: dict[str, Any] = Field(default={})
    key: str = ""
    code: str = ""
    failed: str = ""
    converged: bool = True
    seconds: float = 0.0


def kept(path: Path, depends: Mapping[str, Any] | None) -> Done | None:
    """The results in a cell's file, if they depend on the same; with None in any case.

    :raises Damaged: the file is damaged.
    """
    if not path.exists():
        return None
    done = read_record(path, Done, "remove it and run the study again: this cell alone is done anew")
    return done if depends is None or done.depends == json.loads(json.dumps(depends)) else None


def work_of(path: Path) -> Path:
    """The folder with the fits of the cell whose results are in ``path``."""
    return path.parents[1] / "work" / path.stem


def commit_of(path: Path) -> str:
    """The last commit that changed the library, a declaration or the scripts beside it; ``-dirty`` if changed since.

    Where the library is in no repository: its version.
    """
    root, path = Path(__file__).parents[2], path.resolve()
    beside = [str(path), f":(glob){path.parent}/*.py"] if path.is_relative_to(root) else []

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words, "--", "ddco_pyro", "tasks", *beside]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        commit, changed = git("log", "-1", "--format=%H")[:10], git("status", "--porcelain")
    except (OSError, subprocess.CalledProcessError):
        commit = changed = ""
    return commit + DIRTY * bool(changed) if commit else version("ddco-pyro")


def do(
    path: Path, depends: Mapping[str, Any], work: Callable[[Path], Mapping[str, Any]], code: str = "", **named: Any
) -> str:
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
            begun = folder / "code"
            if (path.exists() and before is None) or not begun.exists() or begun.read_text(encoding="utf-8") != code:
                shutil.rmtree(folder / "fit", ignore_errors=True)  # of other defaults or of another commit
            write_text(begun, code)
            done: dict[str, Any] = {"depends": dict(depends), "key": path.stem, "code": code}
            try:
                with one_thread():
                    done |= work(folder)
            except Exception as error:  # other cells go on, and the reason is shown
                done["failed"] = reason(error)
            done["seconds"] = time.perf_counter() - began
            write_text(path, json_text({**named, **Done(**done).model_dump()}))
            return str(done.get("failed", ""))
    except Busy:
        return ""


def do_all(calls: Mapping[str, Callable[[], str]], kept: int, workers: Workers, on_event: OnEvent = ignore) -> None:
    """Make the calls of :func:`do`, by the name of the cell; ``kept`` is the number of other cells, which are done.

    :raises Failed: a process died.
    """
    on_event(CellsBegan("study", len(calls) + kept, kept))
    with run_all(calls, workers, "did a cell") as done:
        for name, failed in done:
            on_event(CellDone(name, failed))


@dataclass(frozen=True)
class State:
    """The cells of a study, and the results of those that are done or have failed."""

    cells: Sequence[Cell]
    results: Mapping[Cell, Done]

    @cached_property
    def done(self) -> dict[Cell, Done]:
        """The results of the cells that are done."""
        return {cell: one for cell, one in self.results.items() if not one.failed}

    @cached_property
    def failed(self) -> dict[Cell, Done]:
        """The results of the cells that failed."""
        return {cell: one for cell, one in self.results.items() if one.failed}

    @cached_property
    def missing(self) -> list[Cell]:
        """The cells that are neither done nor failed."""
        return [cell for cell in self.cells if cell not in self.results]

    @property
    def codes(self) -> list[str]:
        """The commits of the results, each once."""
        return [*dict.fromkeys(one.code for one in self.results.values())]


@dataclass(frozen=True)
class Folder:
    """A study and the folder of its results."""

    study: Study
    path: Path

    # --- what there is ------------------------------------------------------------------------------------------------

    def cells(self, part: str, chosen: Mapping[str, dict[str, Any]] | None = None) -> list[Cell]:
        """The cells of a part: all of a training seed before another one.

        :param chosen: the point of the grid of each method; None for all points.
        """
        declared, block = self.study.declared, getattr(self.study.declared.seeds, part)
        return [
            Cell(part, task, declared.label(method, point, part), count, block.first + place, method, point, place)
            for place in range(block.count)
            for count in declared.demonstrations.counts
            for task in (part != "test" and declared.choose_on) or self.study.tasks
            for method in declared.methods
            for point in ([chosen[method]] if chosen else declared.points(method))
        ]

    def state(self) -> State:
        """The state of all cells; those of the test are unknown until development has chosen the points.

        :raises Damaged: the file of a cell is damaged.
        :raises BadInput: the study is pinned, and results are of several commits or of other settings.
        """
        choose = self.study.declared.choose
        state = self._state(self.cells(PARTS[choose is not None]))
        if not choose or state.missing or (state.failed and choose not in self.study.declared.failed):
            return state
        return self._state([*state.cells, *self.cells("test", self.chosen(state))])

    def _state(self, cells: Sequence[Cell]) -> State:
        state = State(cells, {cell: one for cell in cells if (one := self.kept(cell))})
        if self.study.declared.pinned and len(codes := state.codes) > 1:
            raise BadInput(f"{self.study.path}: pinned: results are of commits {', '.join(codes)}; keep those of one")
        return state

    def chosen(self, state: State) -> dict[str, dict[str, Any]]:
        """The point of each method with the highest mean over the development cells."""
        rows = [
            (cell.of, json.dumps(cell.point), one.values.get(str(self.study.declared.choose)))
            for cell, one in self.counted(state).items()
            if cell.part == "development"
        ]
        scores = pd.DataFrame(rows, columns=["of", "point", "value"]).fillna(-math.inf)
        means = scores.groupby(["of", "point"], sort=False).value.mean()
        return {str(of): json.loads(own.idxmax()[1]) for of, own in means.groupby("of")}

    def counted(self, state: State) -> dict[Cell, Done]:
        """The results of all cells that are done, and those that failed ones count."""
        values = self.study.declared.failed
        failed = {cell: one.model_copy(update={"values": values}) for cell, one in state.failed.items() if values}
        return {**state.done, **failed}

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
        if known and pinned and known.key != self.key(cell):
            there, here = known.key or "unknown", self.key(cell)
            raise BadInput(
                f"{self.study.path}: pinned: {cell}: was done with key {there}, here is {here}; go back to what was "
                "declared then, or remove its results"
            )
        return known

    @cached_property
    def code(self) -> str:
        """The commit of the code."""
        return commit_of(self.study.path)

    @cached_property
    def _earlier(self) -> dict[Any, pd.DataFrame]:
        """The rows of the declaration's tables ``kept``, by cell."""
        return dict(iter(earlier(self.study).groupby(CELL)))

    def table(self, state: State) -> pd.DataFrame:
        """The declared measures of all cells, tidy; methods of the development name their points."""
        rows = []
        for cell, one in self.counted(state).items():
            values = {measure: one.values.get(measure) for measure in self.study.declared.measures}
            values |= {FAILED: 1 if one.failed else None, RISING: None if one.converged else 1}
            named = (self.study.name, *cell.row)
            rows += [(*named, *item, one.key, one.code) for item in values.items() if item[1] is not None]
        return pd.DataFrame(rows, columns=[*COLUMNS, *ORIGIN])

    # --- keys ---------------------------------------------------------------------------------------------------------

    def place(self, cell: Cell) -> Path:
        """The file of a cell's results."""
        return self.path / "cells" / f"{self.key(cell)}.json"

    def key(self, cell: Cell) -> str:
        """The digest of what the declaration says of a cell."""
        depends = {**self.depends(cell), "added": None}
        return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()[:16]

    def depends(self, cell: Cell) -> dict[str, Any]:
        """What the results of a cell depend on; ``added`` is what the code adds: defaults, or the template of init."""
        study, own, block = self.study, self.study.declared.demonstrations, self._block(cell)
        method, starts = study.declared.methods[cell.of], self._starts(cell)
        baseline, given, added = method.baseline, study.changes(cell.of, cell.point), dict[str, Any]()
        if study.base is None:
            added = {"template": hashlib.sha256(TEMPLATE.read_bytes()).hexdigest()[:16]}
        else:
            spec = with_overrides(study.base, {**given, **self._placed(cell, "demonstrations.hdf5")})
            baseline = baseline and named_baselines(spec).get(baseline.name, baseline)
            shown = {"report", "selection", "compare_with"}  # what a result does not depend on
            given, added = (
                spec.model_dump(mode="json", exclude=shown, exclude_defaults=bare) for bare in (True, False)
            )
        if study.source is None:
            drawn = {"task": cell.task, "supervisor": own.supervisor, "first": block.of(cell.place).start,
                     "train": cell.demonstrations, "held_out": own.held_out}  # fmt: skip
        else:
            drawn = {
                "names": self._divided(cell),
                "digest": self._digest.model_dump(include={"controls", "observations", "labels"}),
            }
        return {
            "baseline": baseline and baseline.model_dump(exclude_unset=True, mode="json"),
            "by": method.by,
            "settings": study.settings(cell.of, cell.point),
            "world": study.declared.world,
            "data": drawn,
            "seed": cell.seed,
            "starts": [*starts[:1], len(starts)],
            "given": given,
            "added": added,
        }

    def _block(self, cell: Cell) -> Any:
        return getattr(self.study.declared.demonstrations, cell.part)

    def _starts(self, cell: Cell) -> range:
        starts = self.study.declared.starts
        return range(0) if starts is None else getattr(starts, cell.part).of(cell.place)  # type: ignore[no-any-return]

    @cached_property
    def _digest(self) -> Digest:
        """The digest of the file of demonstrations; pictures are read once."""
        known = recorded(self.path)
        found = digest(Demonstrations.read(str(self.study.source)), known)
        if known != found and self.path.exists():
            write_text(self.path / "demonstrations.json", found.model_dump_json(indent=1) + "\n")
        return found

    @cached_property
    def _names(self) -> list[str]:
        """The demonstrations in the study's file, in natural order."""
        with open_source(str(self.study.source)) as source:
            return sorted(source.names, key=natural)

    def _divided(self, cell: Cell, names: Sequence[str] = ()) -> tuple[list[str], list[str]]:
        """The names of the training and of the held-out demonstrations of a cell.

        From a study's file they are drawn by the training seed; recorded ones are taken in their order. A seed's
        demonstrations are among those that the seed has where there are more of them.

        :param names: of recorded demonstrations.
        :raises BadInput: there are too few demonstrations.
        """
        own, block, count = self.study.declared.demonstrations, self._block(cell), cell.demonstrations
        if self.study.source is not None:
            there = self._names if block is None else self._names[block.first : block.first + block.count]
            if len(there) < (needed := own.held_out + max(own.counts)):
                raise BadInput(
                    f"{self.study.source}: has {len(there)} demonstrations for {cell.part}, but the study needs "
                    f"{needed}; lower demonstrations.counts or held_out"
                )
            names = [there[n] for n in np.random.default_rng(cell.seed).permutation(len(there))]
        train, valid = names[own.held_out : own.held_out + count], names[: own.held_out]
        return sorted(train, key=natural), sorted(valid, key=natural)

    # --- the work -----------------------------------------------------------------------------------------------------

    def run(self, workers: Workers, on_event: OnEvent = ignore) -> State:
        """Do all cells that are not done; failed ones are tried again. Returns the state afterwards.

        :raises BadInput: the file of demonstrations, the adapter or a task cannot be used; a pinned study's code has
            changes that are not committed, or other results are of another commit.
        :raises Failed: a process died.
        """
        self.study.world()  # or something is wrong with it
        if self.study.declared.pinned and self.code.endswith(DIRTY):
            commit = self.code.removesuffix(DIRTY)
            raise BadInput(f"{self.study.path}: pinned: the code has changes since {commit}; commit them")
        compile_all()
        self.path.mkdir(parents=True, exist_ok=True)
        there = Folder(replace(self.study, path=self.study.path.resolve()), self.path.resolve())  # wherever workers are
        vars(there)["code"] = self.code  # of when the run began
        state, tried = self.state(), set[Cell]()
        if (
            self.study.declared.pinned
            and len(state.done) < len(state.cells)
            and (others := [*{*state.codes} - {self.code}])
        ):
            raise BadInput(
                f"{self.study.path}: pinned: results are of commit {others[0]}, here is {self.code}; run it at that "
                "commit, or remove them"
            )
        while cells := [cell for cell in state.cells if cell not in state.done and cell not in tried]:
            calls = {str(cell): partial(there.do, cell) for cell in cells}
            do_all(calls, len(state.done), workers, on_event)
            tried |= {*cells}
            state = self.state()  # development, once done, adds the cells of the test
        return state

    def do(self, cell: Cell) -> str:
        """Do a cell, as :func:`do` does."""
        return do(self.place(cell), self.depends(cell), partial(self._measured, cell), self.code, cell=asdict(cell))

    def _measured(self, cell: Cell, folder: Path) -> dict[str, Any]:
        """The measures of a cell."""
        study, starts, world = self.study, self._starts(cell), self.study.world()
        spec, demos = self._prepared(cell, world)
        if (by := study.declared.methods[cell.of].by) is not None:
            job = Job(cell, spec, demos, starts, folder, study.settings(cell.of, cell.point))
            return {"values": dict(world.methods[by](job))}
        fitted = fit(spec, demos, out=folder / "fit", keep=False)
        found = fitted.metrics.agreement
        values: dict[str, float | None] = {NATS: fitted.metrics.log_likelihood_per_step.valid}
        if spec.hierarchy and found and found.valid and (own := found.valid[0]):  # of the lowest level
            values |= {name: getattr(own, name) for name in UNMATCHED}
            values |= {name: getattr(own.matched_globally, name) for name in MATCHED}
        if starts and world is not None:
            values |= _means(world.play(cell.task, fitted, starts, folder))
        elif starts:
            episodes = run_episodes(cell.task, fitted.controller(), starts, 0, 1, spec.observed, ())
            values |= _means([episode.outcome for episode in episodes])
        return {"values": values, "converged": fitted.metrics.training.converged}

    def _prepared(self, cell: Cell, world: World | None) -> tuple[Spec, Demonstrations]:
        """The spec of a cell and its demonstrations, which are recorded first where they are not there."""
        study, base = self.study, self.study.base
        file = study.source or self._recorded(cell, world)
        with open_source(file) as source:
            names = sorted(source.names, key=natural)
        train, valid = self._divided(cell, names)
        unused = [name for name in names if name not in {*train, *valid}]
        if base is None:
            facts = replace(inspect(file, exclude=[*valid, *unused]), excluded=(), masks={})  # no others are shown
            base = parse_spec(read_yaml(starting_spec(facts, file).text))
        placed = self._placed(cell, study.declared.demonstrations.path or file.relative_to(self.path).as_posix())
        spec = with_overrides(base, {**study.changes(cell.of, cell.point), **placed})
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
        return with_overrides(spec, {"compare_with": _mixtures(spec)}), demos

    def _placed(self, cell: Cell, path: str) -> dict[str, Any]:
        """What a spec says of a cell's data, by key path. The path is relative: the study's folder may move."""
        own = {"path": path, "exclude": [], "count": max(2, cell.demonstrations), "seed": 0}
        changes = {f"demonstrations.{key}": value for key, value in own.items()}
        task = {"task": cell.task} if cell.task and self.study.declared.world is None else {}
        return changes | {"training.seed": None, "seed": cell.seed} | task

    def _recorded(self, cell: Cell, world: World | None) -> Path:
        """The recorded demonstrations of a task and training seed, the same for all methods and numbers."""
        own, base = self.study.declared.demonstrations, self.study.base
        seeds, count = self._block(cell).of(cell.place), own.held_out + max(own.counts)
        path = self.path / "demonstrations" / f"{cell.task.replace(':', '-')}-{seeds.start}-{count}.hdf5"
        if world is None:
            wanted, observed = (base.demonstrations, base.observed) if base else (DemonstrationsSpec(), [])
            how = {"count": count, "seed": seeds.start, "supervisor": own.supervisor or wanted.supervisor}
            return collect(wanted.task or cell.task, wanted.model_copy(update=how), path, observed=observed)
        with only_one(self.path / "work" / path.stem, wait=True):
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                world.collect(cell.task, seeds, count, path)
        return path


def _mixtures(spec: Spec) -> list[dict[str, Any]]:
    """The mixtures beside a hierarchy, which it is not to be less likely than."""
    mixtures = (one for one in spec.compare_with if spec.hierarchy and one.kind == "mixture")
    return [one.model_dump(exclude_unset=True) for one in mixtures]


def _means(played: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """The mean of each outcome over the episodes to which it applies (is no NaN)."""
    means = pd.DataFrame(list(played)).mean()
    return {str(name): None if math.isnan(mean) else mean for name, mean in means.items()}
