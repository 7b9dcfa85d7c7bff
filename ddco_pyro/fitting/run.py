"""A run: everything between a spec and its folder."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ddco_pyro.data.control_parts import measure
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import json_text, leftovers, only_one, write_text
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.memory import allowed
from ddco_pyro.data.tensors import write_tensors
from ddco_pyro.evaluation.schema import read_record
from ddco_pyro.events import EpochEnded, Event, OnEvent, TrainingBegan, TrainingEnded, ignore
from ddco_pyro.fitting.fit import Fit, RunError, is_finished, load, model_name
from ddco_pyro.fitting.fitted_to import record, recorded
from ddco_pyro.fitting.metrics import evaluate, supervisor, trained_labels
from ddco_pyro.inference.check import STEPS, TRAJECTORIES, EngineCheck, compare_engines
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.model.encoding import refuse_unusable
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.seeding import seeded
from ddco_pyro.spec import Spec, dump_spec, load_spec, with_overrides
from ddco_pyro.training import labels
from ddco_pyro.training.checkpoint import copy_of
from ddco_pyro.training.data import demonstrations as read_demonstrations
from ddco_pyro.training.data import dimensions, known_demonstrations, parts, refuse_unfit, seen
from ddco_pyro.training.devices import repeatable
from ddco_pyro.training.jobs import check_jobs
from ddco_pyro.training.launching import check_processes, together
from ddco_pyro.training.loop import SAVE_EVERY
from ddco_pyro.training.networks import Dimensions, baseline_spec, check_networks, named_baselines, parameters
from ddco_pyro.training.objective import TrainingError
from ddco_pyro.training.ranks import ALONE, Ranks
from ddco_pyro.training.restarts import Trainer

PACKAGES = ("ddco-pyro", "torch", "pyro-ppl", "numpy", "dm-control", "mujoco", "ompl", "scikit-learn")


def fit(
    spec: Spec | str | Path,
    demonstrations: Demonstrations | str | Path | None = None,
    out: str | Path | None = None,
    on_event: OnEvent = ignore,
    jobs: int = 1,
    processes: int = 1,
) -> Fit:
    """Fit a spec's hierarchy and its baselines to demonstrations, and evaluate them.

    >>> import numpy as np
    >>> random = np.random.default_rng(0)
    >>> def demonstration(n):  # to the place, then away from it
    ...     place = random.normal(size=(10, 2))
    ...     return ddco_pyro.Demonstration(f"demo_{n}", {"place": place}, place * np.repeat([[-2.0], [2.0]], 5, 0))
    >>> demos = ddco_pyro.Demonstrations(tuple(demonstration(n) for n in range(6)))
    >>> fit = ddco_pyro.fit("mine.yaml", demos)
    >>> fit.metrics["demonstrations"]
    {'train': 4, 'tune': 1, 'valid': 1}
    >>> ddco_pyro.fit("mine.yaml", demos, out="runs/mine").folder.as_posix()
    'runs/mine'

    :param spec: a spec, or its YAML file; one that names user code is given by ``load_spec(path, allow_code=True)``.
    :param demonstrations: in memory, in any order, or the HDF5 file to use instead of ``demonstrations.path``; None for
        those that the spec names.
    :param out: the run folder, as ``ddco-pyro fit`` makes it, with demonstrations from memory kept in it; None to write
        nothing. A folder that holds part of this run is continued; one that holds all of it is left as it is.
    :param on_event: is told how it goes on.
    :param jobs: processes that train restarts, -1 for one on each core; the result is the same for any number. In a
        script, more than one needs the usual ``if __name__ == "__main__":``.
    :param processes: processes that share the work of each gradient step instead, at most ``training.shards``; the
        result is the same for any number.
    :raises BackendError: so many processes cannot share the work.
    :raises SpecError: something in the spec does not fit the demonstrations.
    :raises DemonstrationsError: they cannot be used.
    :raises RunError: the folder holds something else.
    :raises OtherDemonstrations: the folder is a run of other demonstrations.
    :raises TrainingError: training stopped; nothing that was written before is lost.
    """
    spec, folder = spec if isinstance(spec, Spec) else load_spec(spec), None if out is None else Path(out)
    if isinstance(demonstrations, Demonstrations):
        in_order = demonstrations.select(sorted(demonstrations.names, key=natural))  # as they are read back
        demonstrations = replace(in_order, masks=demonstrations.masks)
        path = {"demonstrations.path": str(folder / "demonstrations.hdf5")} if folder else {}
        return fit_run(
            with_overrides(spec, path),
            seen(spec, demonstrations),
            folder,
            on_event,
            jobs,
            keep=demonstrations,
            processes=processes,
        )
    path = {} if demonstrations is None else {"demonstrations.path": str(demonstrations)}
    return fit_run(with_overrides(spec, path), None, folder, on_event, jobs, processes=processes)


def fit_run(
    spec: Spec,
    demos: Demonstrations | None,
    folder: Path | None,
    on_event: OnEvent = ignore,
    jobs: int = 1,
    resume: bool = True,
    keep: Demonstrations | None = None,
    processes: int = 1,
) -> Fit:
    """:func:`fit`, with everything that can be refused refused before anything is collected, trained or written.

    :param demos: as the spec sees them; None for those that it names, which are read once.
    :param resume: whether the folder may hold all of this run already.
    :param keep: demonstrations that the run is to have a copy of, in the file that the spec names.
    """
    check_jobs(jobs)
    check_processes(processes, jobs, spec.training.shards)
    allowed()
    clock = _Clock()
    with clock("demonstrations"):
        demos = known_demonstrations(spec) if demos is None else demos
        check_networks(spec, dimensions(spec, demos))
        if demos is not None:
            refuse_unfit(spec, demos)
            labels.used(spec, demos)
    if folder is None:
        demos = demos or read_demonstrations(spec, on_event)
        with together(processes) as ranks:
            return _fit(spec, demos, None, on_event, jobs, ranks, clock)
    with claimed(folder, spec, resume):
        finished = is_finished(folder)
        with clock("demonstrations"):
            if demos is None and not finished:
                demos = read_demonstrations(spec, on_event)
            if demos is not None:
                record(folder, demos)
        if keep is not None and not (kept := Path(str(spec.demonstrations.path))).exists():
            keep.write(kept)
        if finished:
            return replace(load(folder, allow_code=True), given=demos)  # it is this very spec, which the caller has
        assert demos is not None
        for part in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            for old in leftovers(part):
                old.unlink()
        with together(processes) as ranks:
            return _fit(spec, demos, folder, on_event, jobs, ranks, clock)


def _fit(
    spec: Spec,
    demos: Demonstrations,
    folder: Path | None,
    on_event: OnEvent,
    jobs: int,
    ranks: Ranks,
    clock: _Clock,
    name: str | None = None,
) -> Fit:
    """:param name: what the model is called in events."""
    if folder:
        on_event = clock.go_on(folder, on_event)
    split = parts(spec, demos)
    dimensions = Dimensions.of(demos)
    with clock("training"):
        checkpoints = folder / "checkpoints" if folder else None
        held_out = split.get("valid")
        trained = train(spec, dimensions, split["train"], on_event, checkpoints, held_out, name, jobs, ranks)
    if folder:
        _write_history(folder, trained.history)
        _write_model(folder, trained.hierarchy, dimensions)
    with clock("baselines"):
        beside = {
            name: _baseline(baseline_spec(spec, baseline, dimensions), demos, folder, on_event, jobs, ranks, name)
            for name, baseline in named_baselines(spec).items()
        }
    fitted = Fit(spec, trained.hierarchy, {}, folder, demos, beside)
    with clock("evaluation"), repeatable(fitted.hierarchy.device):
        metrics = evaluate(fitted, split, demos)
    metrics |= {
        "engine_check": trained.check._asdict(),
        "demonstrations": trained.demonstrations | {"valid": len(split.get("valid", ()))} | supervisor(demos),
        "measure": measure(trained.hierarchy.scaling.parts),
        "control_dimensions": [dimension.as_data() for dimension in dimensions.control],
        "parameters": parameters(trained.hierarchy),
        "training": trained.training,
        **trained_labels(fitted, demos),
        "seconds": clock.end(),
        "versions": {package: importlib.metadata.version(package) for package in PACKAGES},
    }
    if folder:
        write_metrics(folder, metrics)
    return replace(fitted, metrics=json.loads(json_text(metrics)))  # as they are read back


def _baseline(
    spec: Spec, demos: Demonstrations, run: Path | None, on_event: OnEvent, jobs: int, ranks: Ranks, name: str
) -> Fit:
    """A baseline trained beside, in a folder of its own where the run has one; nothing where it was done before."""
    folder = run / "baselines" / name if run else None
    if run and folder:
        claim(folder, spec)
        record(folder, demos, recorded(run))
        if is_finished(folder):
            return load(folder, allow_code=True)
    return _fit(spec, demos, folder, on_event, jobs, ranks, _Clock(), name)


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``."""
    write_text(folder / "metrics.json", json_text(metrics))


@contextmanager
def claimed(folder: Path, spec: Spec, resume: bool = True) -> Iterator[None]:
    """The folder is this spec's run, and no other process works on it, while the block lasts.

    :param resume: as of :func:`claim`.
    :raises RunError: it is a file, or as :func:`claim`.
    :raises Busy: another process is at work on it.
    """
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder}: is a file; choose another --out")
    with only_one(folder):
        claim(folder, spec, resume)
        yield


def claim(folder: Path, spec: Spec, resume: bool = True) -> None:
    """Make the folder this spec's run.

    A part of this very run is continued.

    :param resume: whether it may hold all of it already.
    :raises RunError: it holds something else, or all of it and may not.
    """
    text, path = dump_spec(spec), folder / "spec.yaml"
    if path.exists():
        if path.read_bytes() != text.encode():
            raise RunError(f"{folder}: holds a run of another spec; choose another --out or remove it")
        if not resume and is_finished(folder) and (folder / "report.html").exists():  # what `fit` writes last
            raise RunError(
                f"{folder}: holds a run of this spec already; show it with --resume, or choose another --out"
            )
        return
    if folder.exists() and set(folder.iterdir()) - set(leftovers(folder)):
        raise RunError(f"{folder}: is not empty and not a run; choose another --out")
    write_text(path, text)


@dataclass(frozen=True)
class Trained:
    """What training gave: the ``hierarchy``, the ``check`` of the engines before it, the ``history`` of its epochs, the
    numbers of ``demonstrations`` that it was trained and tuned on, and what it spent of its budget, ``training``
    (:func:`ddco_pyro.training.convergence.summary`).
    """

    hierarchy: Hierarchy
    check: EngineCheck
    history: list[dict[str, Any]]
    demonstrations: dict[str, int]
    training: dict[str, Any]


def train(
    spec: Spec,
    dimensions: Dimensions,
    demos: Demonstrations,
    on_event: OnEvent = ignore,
    checkpoints: Path | None = None,
    held_out: Demonstrations | None = None,
    name: str | None = None,
    jobs: int = 1,
    ranks: Ranks = ALONE,
) -> Trained:
    """Train the spec's model on these demonstrations, of which ``training.tune_fraction`` are used to tune.

    :param checkpoints: the folder where training is kept to be continued; None for nowhere.
    :param held_out: demonstrations that will be evaluated; whether they can be is known before training.
    :param name: what the model is called in events.
    :param jobs: processes that train restarts; -1 is one for each core.
    :param ranks: processes that train each restart together.
    :raises DemonstrationsError: a number is too large for networks.
    :raises TrainingError: a log-likelihood is not finite, or the engines disagree.
    """
    name, budget = name or model_name(spec), spec.training
    kept, tune = demos.split(budget.tune_fraction, spec.seed)
    with one_thread():
        trainer = Trainer(spec, dimensions, kept, tune, checkpoints, on_event, jobs, ranks)
        if held_out is not None:
            refuse_unusable(held_out, trainer.first.encoder, trainer.first.scaling)
        check = _check_engines(trainer)
        on_event(TrainingBegan(name, None if budget.epochs is None else budget.epochs * budget.restarts))
        hierarchy = trainer.run()
    on_event(TrainingEnded(name))
    counts = {"train": len(kept), "tune": len(tune)}
    return Trained(hierarchy, check, trainer.history, counts, trainer.summary)


def _check_engines(trainer: Trainer) -> EngineCheck:
    """How far the engines are apart before any training.

    :raises TrainingError: they disagree, or the networks give no numbers.
    """
    first, batch = trainer.first, trainer.material.train
    few = batch.select(torch.arange(min(len(batch), TRAJECTORIES)), STEPS)
    with seeded(trainer.spec.seed), torch.no_grad():
        outputs = first(few.inputs)
    if not all(bool(torch.isfinite(values).all()) for values in outputs.tensors()):
        raise TrainingError(
            "before any training a network gives values that are NaN or infinite; look at its code, or at the "
            "ranges of the observations (ddco-pyro inspect)"
        )
    check = compare_engines(outputs, few.actions, few.lengths)
    if not check.agrees:
        raise TrainingError(
            f"the engines disagree (value {check.value:.1e}, gradient {check.gradient:.1e}): "
            "this is a defect; use inference.engine=enumerate and report it"
        )
    return check


def _write_model(folder: Path, hierarchy: Hierarchy, dimensions: Dimensions) -> None:
    shapes = json.dumps({key: list(shape) for key, shape in hierarchy.encoder.shapes.items()})
    metadata = {
        "shapes": shapes,
        "control_size": str(dimensions.control_size),
        "steps": str(dimensions.steps),
        "control": json.dumps([part.as_data() for part in hierarchy.scaling.parts]),
    }
    write_tensors(folder / "model.safetensors", copy_of(hierarchy), metadata)


def _write_history(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, ["restart", "stage", "epoch", "train", "tune"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / "history.csv", text.getvalue())


class _Clock:
    """Seconds by phase, of this process and of those that worked on the run before it was interrupted."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._phase, self._since = "", 0.0
        self._path: Path | None = None
        self._kept_at = -math.inf

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        self._phase, self._since = phase, time.perf_counter()
        try:
            yield
        finally:
            self._add()
            if self._kept_at > -math.inf:
                self._keep()

    def go_on(self, folder: Path, on_event: OnEvent) -> OnEvent:
        """Go on from what is kept in a run folder, and keep it there from the first epoch on, as checkpoints are.

        :returns: to be told in place of ``on_event``, which is told in turn.
        :raises Damaged: what is kept cannot be read.
        """
        self._path = folder / "seconds.json"
        if self._path.exists():
            kept = read_record(self._path, dict[str, float], "remove it and do the same again")
            self.seconds = {
                phase: kept.get(phase, 0) + self.seconds.get(phase, 0) for phase in {**kept, **self.seconds}
            }

        def told(event: Event) -> None:
            self._add()
            if isinstance(event, EpochEnded) and self._since - self._kept_at > SAVE_EVERY:
                self._keep()
            on_event(event)

        return told

    def end(self) -> dict[str, float]:
        """All of them, which the folder has elsewhere from now on."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)
        return self.seconds

    def _add(self) -> None:
        now = time.perf_counter()
        self.seconds[self._phase] = self.seconds.get(self._phase, 0.0) + now - self._since
        self._since = now

    def _keep(self) -> None:
        if self._path is not None:
            self._kept_at = self._since
            write_text(self._path, json.dumps(self.seconds))
