"""A run: everything between a spec and its folder, and a fitted hierarchy read back from there."""

from __future__ import annotations

import csv
import importlib.metadata
import io
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.monitor import Monitor
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import leftovers, only_one, read_tensors, write_tensors, write_text
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting import analysis
from ddco_pyro.fitting.metrics import evaluate, supervisor
from ddco_pyro.fitting.prepare import Dimensions, baseline_spec, build_hierarchy, demonstrations, parameters, parts
from ddco_pyro.fitting.records import read_metrics, refit
from ddco_pyro.fitting.training import Trainer, TrainingError
from ddco_pyro.inference import Posterior, log_likelihood, posterior, segment
from ddco_pyro.inference.check import STEPS, TRAJECTORIES, EngineCheck, compare_engines
from ddco_pyro.inference.decomposition import Decomposition, decompose
from ddco_pyro.model.ahmm import Tables
from ddco_pyro.model.encoding import Batch, encode, refuse_overflow
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.spec import Spec, dump_spec, load_spec, user_code

TOLERANCE = 1e-4
"""Relative; a log-likelihood computed again on another machine differs in the last digits of float32."""

PACKAGES = ("ddco-pyro", "torch", "pyro-ppl", "numpy", "dm-control", "mujoco", "ompl", "scikit-learn")


class RunError(BadInput):
    """A folder is not the run it was taken for."""


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


@dataclass(frozen=True)
class Fit:
    """A fitted model and the folder it lives in. ``metrics`` is ``metrics.json``."""

    folder: Path
    spec: Spec
    hierarchy: Hierarchy

    @property
    def metrics(self) -> dict[str, Any]:
        """The contents of ``metrics.json``.

        :raises Damaged: it lacks something that a reader needs.
        """
        hierarchy = self.spec.hierarchy
        return read_metrics(self.folder, [level.count for level in hierarchy.levels] if hierarchy else [])

    @property
    def name(self) -> str:
        """What the model is called in tables."""
        return model_name(self.spec)

    @cached_property
    def baselines(self) -> dict[str, Fit]:
        """The baselines that were trained beside it, by name."""
        folders = [self.folder / "baselines" / baseline.kind for baseline in self.spec.compare_with]
        allow_code = bool(user_code(self.spec))  # theirs is named in this spec too
        return {folder.name: load(folder, allow_code) for folder in folders if _finished(folder)}

    @cached_property
    def held_out(self) -> dict[str, float]:
        """log p(ξ) of each demonstration that was held out, by name, as it was then."""
        return {one["name"]: one["log_likelihood"] for one in self.metrics["valid"]}

    def was_held_out(self, name: str, log_likelihood: float) -> bool:
        """Whether a demonstration is one of those that were held out: the same name, and as likely as it was then."""
        return bool(np.isclose(self.held_out.get(name, np.nan), log_likelihood, rtol=TOLERANCE, atol=TOLERANCE))

    def log_likelihood(self, demos: Demonstrations) -> np.ndarray:
        """log p(ξ) of each demonstration, nats, [N]; the density is in the control's own units."""
        return log_likelihoods(self.hierarchy, demos)

    def decompose(self, demos: Demonstrations) -> Decomposition:
        """What each control dimension and choosing options add to log p(ξ) of each demonstration."""
        scaling = self.hierarchy.scaling
        with torch.no_grad():
            return Decomposition.joined(
                decompose(self.hierarchy(batch.inputs), batch, scaling) for batch in _batches(self.hierarchy, demos)
            )

    def posterior(self, demos: Demonstrations) -> Posterior:
        """u, v and w of §4.1 for every level."""
        parts = [posterior(*part) for part in _tables(self.hierarchy, demos)]
        u, v, w = (
            tuple(_stacked(level, 0.0) for level in zip(*tables, strict=True)) for tables in zip(*parts, strict=True)
        )
        return Posterior(u, v, w)

    def divergences(self, demos: Demonstrations, posterior: Posterior) -> list[list[dict[str, Any]]]:
        """How differently each two options of a level act (:func:`ddco_pyro.fitting.analysis.divergences`)."""
        with torch.no_grad():
            said = [self.hierarchy(batch.inputs) for batch in _batches(self.hierarchy, demos)]
            return analysis.divergences(_joined(said), posterior)

    def segment(self, demos: Demonstrations) -> tuple[np.ndarray, ...]:
        """Choices of the most likely path, a [N, T] for each level, lowest first; -1 past a demonstration's end."""
        parts = [segment(*part) for part in _tables(self.hierarchy, demos)]
        return tuple(_stacked(level, -1).numpy() for level in zip(*parts, strict=True))

    def controller(self, seed: int = 0) -> Controller:
        """The model as a policy that acts, as the spec's ``rollout`` says."""
        return Controller.from_spec(self.hierarchy, self.spec.rollout, seed)

    def monitor(self) -> Monitor:
        """A live monitor of the active options, for somebody else's acting."""
        return Monitor(self.hierarchy)


def _joined(parts: Sequence[Outputs]) -> Outputs:
    """What the networks say of some demonstrations and of others, padded to the longest; σ is the same of all."""
    leaves: list[Tensor | None] = []
    for column in zip(*(part.leaves() for part in parts), strict=True):
        tensors = [leaf for leaf in column if leaf is not None]
        leaves.append(_stacked(tensors, 0.0) if tensors and tensors[0].dim() > 1 else column[0])
    return Outputs.of(parts[0].options, leaves)


def _stacked(parts: Sequence[Tensor], padding: float) -> Tensor:
    """Parts [N_i, T_i, ...] one below the other, padded to the longest."""
    rows = [row for part in parts for row in part]
    return torch.nn.utils.rnn.pad_sequence(rows, batch_first=True, padding_value=padding)


def log_likelihoods(hierarchy: Hierarchy, demos: Demonstrations) -> np.ndarray:
    """log p(ξ) of each demonstration under a trained hierarchy, nats, [N]."""
    found: np.ndarray = torch.cat([log_likelihood(*part) for part in _tables(hierarchy, demos)]).numpy()
    return found


def _tables(hierarchy: Hierarchy, demos: Demonstrations) -> Iterator[tuple[Tables, Tensor]]:
    """Tables and lengths of the demonstrations, some at a time."""
    with torch.no_grad():
        for batch in _batches(hierarchy, demos):
            yield hierarchy.tabulate(batch), batch.lengths


def _batches(hierarchy: Hierarchy, demos: Demonstrations) -> Iterator[Batch]:
    """The demonstrations as the networks see them, some at a time."""
    for _, batch in encode(demos, hierarchy.encoder, hierarchy.scaling).pieces(hierarchy.steps_at_once):
        yield batch


def model_name(spec: Spec) -> str:
    """``ddco``, or the kind of the baseline."""
    return spec.baseline.kind if spec.baseline else "ddco"


def load(folder: str | Path, allow_code: bool = False) -> Fit:
    """The fit in a run folder.

    :param allow_code: import the user code (``module:name``) that its spec names; nothing else in a run is ever
        executed.
    :raises RunError: the folder has no finished fit, or its model is of another spec.
    :raises Damaged: the model or ``metrics.json`` is damaged.
    :raises SpecError: its spec names user code, and that is not allowed.
    """
    folder = Path(folder)
    missing = [name for name in ("spec.yaml", "model.safetensors", "metrics.json") if not (folder / name).exists()]
    if missing:
        what = "not a run folder" if "spec.yaml" in missing else "an unfinished run: fit it again to continue it"
        if (folder / "folds.json").exists():
            what = f"a selection; the fit of what it chose is in {folder / 'fit'} once it is done"
        raise RunError(f"{folder}: {what} (it has no {missing[0]})")
    spec = load_spec(folder / "spec.yaml", allow_code=allow_code)
    try:
        found = Fit(folder, spec, _read_model(spec, folder / "model.safetensors").eval())
    except BadInput:
        raise
    except (KeyError, ValueError, RuntimeError) as error:
        raise RunError(f"{folder / 'model.safetensors'}: is of another spec than spec.yaml; {refit(folder)}") from error
    _ = found.metrics  # whoever loads a run is told that they are damaged, before any work
    return found


def _read_model(spec: Spec, path: Path) -> Hierarchy:
    tensors, metadata = read_tensors(path, refit(path.parent))
    shapes = {key: tuple(shape) for key, shape in json.loads(metadata["shapes"]).items()}
    size = int(metadata["control_size"])
    whole = {"scaling.varying": torch.arange(size), "scaling.constant": torch.empty(0, dtype=torch.float64)}
    tensors = whole | tensors  # models of before had every dimension in them
    others = sorted(set(range(size)) - set(tensors["scaling.varying"].tolist()))
    constant = dict(zip(others, tensors["scaling.constant"].tolist(), strict=True))
    hierarchy = build_hierarchy(spec, Dimensions(shapes, size, int(metadata["steps"]), constant))
    hierarchy.load_state_dict(tensors)
    return hierarchy


def fit(spec: Spec, folder: Path, watcher: Watcher) -> Fit:
    """Collect or read the demonstrations, train the spec's model and its baselines, evaluate, and fill the run folder.

    A folder that holds part of this run is continued; one that holds all of it is left as it is.

    :raises RunError: the folder holds something else.
    :raises TrainingError: training stopped; nothing that was written before is lost.
    """
    claim(folder, spec)
    with only_one(folder):
        if _finished(folder):
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
            if not _finished(own):
                _fit(beside, own, demos, watcher, _Clock())
    with clock("evaluation"):
        metrics = evaluate(found, split, demos)
    held_out = {"valid": len(split.get("valid", ()))}
    metrics |= {
        "engine_check": trained.check._asdict(),
        "demonstrations": trained.demonstrations | held_out | supervisor(demos),
        "control_dimensions": [dimension.as_data() for dimension in dimensions.control],
        "parameters": parameters(hierarchy),
        "training": trained.training,
        "seconds": clock.seconds,
        "versions": {package: importlib.metadata.version(package) for package in PACKAGES},
    }
    write_metrics(folder, metrics)
    return found


def _finished(folder: Path) -> bool:
    """Whether the run is complete: its metrics are written last. What was damaged and removed is made again."""
    return all((folder / name).exists() for name in ("model.safetensors", "metrics.json"))


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
        if not resume and _finished(folder) and (folder / "report.html").exists():  # what `fit` writes last
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
            refuse_overflow(held_out, first.encoder, first.scaling)
        batches = [encode(part, first.encoder, first.scaling) for part in parts]
        few = batches[0].select(torch.arange(min(len(batches[0]), TRAJECTORIES)), STEPS)
        with torch.no_grad():
            outputs = first(few.inputs)
        if not all(bool(torch.isfinite(leaf).all()) for leaf in outputs.leaves() if leaf is not None):
            raise TrainingError(
                "before any training a network gives values that are NaN or infinite; look at its code, or at the "
                "ranges of the observations (ddco-pyro inspect)"
            )
        check = compare_engines(outputs, few.actions, first.scaling.log_volume, few.lengths)
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
    metadata = {"shapes": shapes, "control_size": str(dimensions.control_size), "steps": str(dimensions.steps)}
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
