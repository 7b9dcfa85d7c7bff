"""A fitted hierarchy: what it says of demonstrations, how it acts, and reading it back from its run folder."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.monitor import Monitor
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.tensors import read_tensors
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting import analysis
from ddco_pyro.fitting.prepare import Dimensions, build_hierarchy
from ddco_pyro.fitting.records import read_metrics, refit
from ddco_pyro.inference import Posterior, log_likelihood, posterior, segment
from ddco_pyro.inference.decomposition import Decomposition, decompose
from ddco_pyro.model.control_parts import ControlPart
from ddco_pyro.model.encoding import Batch, encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables
from ddco_pyro.spec import Spec, load_spec, user_code

TOLERANCE = 1e-4
"""Relative; a log-likelihood computed again on another machine differs in the last digits of float32."""


class RunError(BadInput):
    """A folder is not the run it was taken for."""


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
        return {folder.name: load(folder, allow_code) for folder in folders if is_finished(folder)}

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
        with torch.no_grad():
            return Decomposition.joined(
                decompose(self.hierarchy(batch.inputs), batch) for batch in _batches(self.hierarchy, demos)
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
            return analysis.divergences(self._with_posterior(demos, posterior))

    def _with_posterior(self, demos: Demonstrations, posterior: Posterior) -> Iterator[tuple[Outputs, Posterior]]:
        """What the networks say of the demonstrations, some at a time, and the same steps of the posterior."""
        for rows, batch in encode(demos, self.hierarchy.encoder, self.hierarchy.scaling).pieces(
            self.hierarchy.steps_at_once
        ):
            steps = batch.inputs.batch[1]
            yield (
                self.hierarchy(batch.inputs),
                Posterior(*(tuple(u[rows, :steps] for u in table) for table in posterior)),
            )

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
    kinds = json.loads(metadata["control"]) if "control" in metadata else None  # models of before are Gaussian
    parts = None if kinds is None else tuple(ControlPart.of(part) for part in kinds)
    hierarchy = build_hierarchy(spec, Dimensions(shapes, size, int(metadata["steps"]), constant, parts=parts))
    hierarchy.load_state_dict(tensors)
    return hierarchy


def is_finished(folder: Path) -> bool:
    """Whether the run is complete: its metrics are written last. What was damaged and removed is made again."""
    return all((folder / name).exists() for name in ("model.safetensors", "metrics.json"))
