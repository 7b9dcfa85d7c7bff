"""A run: everything between a spec and its folder."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import leftovers, only_one, write_text
from ddco_pyro.data.tensors import write_tensors
from ddco_pyro.fitting.fit import Fit, RunError, is_finished, load, model_name
from ddco_pyro.fitting.metrics import evaluate, supervisor
from ddco_pyro.fitting.prepare import Dimensions, baseline_spec, build_hierarchy, demonstrations, parameters, parts
from ddco_pyro.fitting.training import Trainer, TrainingError
from ddco_pyro.inference.check import STEPS, TRAJECTORIES, EngineCheck, compare_engines
from ddco_pyro.model.encoding import encode, refuse_unusable
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec, dump_spec

PACKAGES = ("ddco-pyro", "torch", "pyro-ppl", "numpy", "dm-control", "mujoco", "ompl", "scikit-learn")


class Watcher(Protocol):
    """Is told how a fit goes on."""

    def collected(self, done: int, total: int) -> None:
        """So many of the demonstrations have been collected."""

    def training(self, name: str, epochs: int | None) -> None:
        """A model begins to be trained, for at most so many epochs in all; None for no limit."""

    def epoch(self, row: dict[str, Any]) -> None:
        """An epoch has ended; its row of the history."""

    def trained(self, name: str) -> None:
        """A model has been trained."""


def fit(spec: Spec, folder: Path, watcher: Watcher) -> Fit:
    """Collect or read the demonstrations, train the spec's model and its baselines, evaluate, and fill the run folder.

    A folder that holds part of this run is continued; one that holds all of it is left as it is.

    :raises RunError: the folder holds something else.
    :raises TrainingError: training stopped; nothing that was written before is lost.
    """
    claim(folder, spec)
    with only_one(folder):
        if is_finished(folder):
            return load(folder, allow_code=True)  # it is this very spec, which the caller has
        for part in (folder, *(path for path in folder.rglob("*") if path.is_dir())):
            for old in leftovers(part):
                old.unlink()
        clock = _Clock()
        with clock("demonstrations"):
            demos = demonstrations(spec, watcher.collected)
        return _fit(spec, folder, demos, watcher, clock)


def _fit(spec: Spec, folder: Path, demos: Demonstrations, watcher: Watcher, clock: _Clock) -> Fit:
    split = parts(spec, demos)
    dimensions = Dimensions.of(demos)
    with clock("training"):
        checkpoint = folder / "checkpoints" / "latest.safetensors"
        trained = train(spec, dimensions, split["train"], watcher, checkpoint, split.get("valid"))
    hierarchy = trained.hierarchy
    _write_history(folder, trained.history)
    _write_model(folder, hierarchy, dimensions)
    found = Fit(folder, spec, hierarchy)
    with clock("baselines"):
        for baseline in spec.compare_with:
            own, beside = folder / "baselines" / baseline.kind, baseline_spec(spec, baseline, dimensions)
            claim(own, beside)
            if not is_finished(own):
                _fit(beside, own, demos, watcher, _Clock())
    with clock("evaluation"):
        metrics = evaluate(found, split, demos)
    held_out = {"valid": len(split.get("valid", ()))}
    metrics |= {
        "engine_check": trained.check._asdict(),
        "demonstrations": trained.demonstrations | held_out | supervisor(demos),
        "measure": hierarchy.scaling.measure,
        "control_dimensions": [dimension.as_data() for dimension in dimensions.control],
        "parameters": parameters(hierarchy),
        "training": trained.training,
        "seconds": clock.seconds,
        "versions": {package: importlib.metadata.version(package) for package in PACKAGES},
    }
    write_metrics(folder, metrics)
    return found


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write ``metrics.json``."""
    write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")


def claim(folder: Path, spec: Spec, resume: bool = True) -> None:
    """Make the folder this spec's run.

    A part of this very run is continued.

    :param resume: whether it may hold all of it already.
    :raises RunError: it holds something else, or all of it and may not.
    """
    text, path = dump_spec(spec), folder / "spec.yaml"
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder}: is a file; choose another --out")
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
    (:func:`ddco_pyro.fitting.convergence.summary`).
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
    watcher: Watcher,
    checkpoint: Path | None = None,
    held_out: Demonstrations | None = None,
) -> Trained:
    """Train the spec's model on these demonstrations, of which ``training.tune_fraction`` are used to tune.

    :param checkpoint: where training is kept to be continued; None for nowhere.
    :param held_out: demonstrations that will be evaluated; whether they can be is known before training.
    :raises DemonstrationsError: a number is too large for networks.
    :raises TrainingError: a log-likelihood is not finite, or the engines disagree.
    """
    kept, tune = demos.split(spec.training.tune_fraction, spec.seed)
    with one_thread():
        return _train(spec, dimensions, (kept, tune), watcher, checkpoint, held_out)


def _train(
    spec: Spec,
    dimensions: Dimensions,
    parts: tuple[Demonstrations, Demonstrations],
    watcher: Watcher,
    checkpoint: Path | None,
    held_out: Demonstrations | None,
) -> Trained:
    kept, tune = parts

    def make() -> Hierarchy:
        hierarchy = build_hierarchy(spec, dimensions)
        hierarchy.encoder.fit(kept)
        hierarchy.scaling.fit(kept)
        return hierarchy

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(spec.seed)
        first = make()
        if held_out is not None:
            refuse_unusable(held_out, first.encoder, first.scaling)
        batches = [encode(part, first.encoder, first.scaling) for part in parts]
        few = batches[0].select(torch.arange(min(len(batches[0]), TRAJECTORIES)), STEPS)
        with torch.no_grad():
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
    training = spec.training
    watcher.training(model_name(spec), None if training.epochs is None else training.epochs * training.restarts)
    trainer = Trainer(spec, make, batches[0], batches[1], checkpoint, list(kept.names), watcher.epoch)
    hierarchy = trainer.run()
    watcher.trained(model_name(spec))
    counts = {"train": len(kept), "tune": len(tune)}
    return Trained(hierarchy, check, trainer.progress.history, counts, trainer.summary)


def _write_model(folder: Path, hierarchy: Hierarchy, dimensions: Dimensions) -> None:
    shapes = json.dumps({key: list(shape) for key, shape in hierarchy.encoder.shapes.items()})
    metadata = {
        "shapes": shapes,
        "control_size": str(dimensions.control_size),
        "steps": str(dimensions.steps),
        "control": json.dumps([part.as_data() for part in hierarchy.scaling.parts]),
    }
    write_tensors(folder / "model.safetensors", hierarchy.state_dict(), metadata)


def _write_history(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, ["restart", "stage", "epoch", "train", "tune"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / "history.csv", text.getvalue())


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside, torch works on one thread: faster than on several where networks are small, and the same everywhere."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Clock:
    """Seconds by phase."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[phase] = time.perf_counter() - start
