"""A fitted hierarchy: what it says of demonstrations, how it acts, and reading it back from its run folder."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.monitor import Monitor
from ddco_pyro.data.control_parts import ControlPart
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import Damaged
from ddco_pyro.data.tensors import read_tensors
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.inferred import Inferred, infer
from ddco_pyro.evaluation.schema import read_metrics, refit
from ddco_pyro.fitting.fitted_to import refuse_others
from ddco_pyro.inference import Posterior
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec, load_spec, user_code
from ddco_pyro.training.data import demonstrations
from ddco_pyro.training.networks import Dimensions, build_hierarchy, named_baselines

TOLERANCE = 1e-4
"""Relative; a log-likelihood computed again on another machine differs in the last digits of float32."""


class RunError(BadInput):
    """A folder is not the run it was taken for."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    :param metrics: its numbers, the contents of ``metrics.json``.
    :param folder: its run folder; None where it was not written.
    :param given: the demonstrations that it was fitted to; None for those that the spec names.
    :param beside: the baselines that were trained beside it, by name; None for those in its folder.
    """

    spec: Spec
    hierarchy: Hierarchy
    metrics: dict[str, Any] = field(default_factory=dict, repr=False)
    folder: Path | None = None
    given: Demonstrations | None = field(default=None, repr=False)
    beside: Mapping[str, Fit] | None = field(default=None, repr=False)

    def __str__(self) -> str:
        return str(self.folder or "this fit")

    @property
    def run_folder(self) -> Path:
        """The folder, for what is read from it or written into it.

        :raises RunError: there is none.
        """
        if self.folder is None:
            raise RunError("this fit has no run folder; fit with out=FOLDER, which this needs")
        return self.folder

    @property
    def name(self) -> str:
        """What the model is called in tables."""
        return model_name(self.spec)

    @cached_property
    def demonstrations(self) -> Demonstrations:
        """The demonstrations that it was fitted to, training and held out; those of a run are read when asked for.

        :raises OtherDemonstrations: their file holds others by now.
        """
        if self.given is not None:
            return self.given
        demos = demonstrations(self.spec)
        if self.folder is not None:
            refuse_others(self.folder, demos)
        return demos

    @cached_property
    def baselines(self) -> Mapping[str, Fit]:
        """The baselines that were trained beside it, by name."""
        if self.beside is not None or self.folder is None:
            return self.beside or {}
        folders = [self.folder / "baselines" / name for name in named_baselines(self.spec)]
        allow_code = bool(user_code(self.spec))  # theirs is named in this spec too
        return {folder.name: load(folder, allow_code) for folder in folders if is_finished(folder)}

    @cached_property
    def held_out(self) -> dict[str, float]:
        """log p(ξ) of each demonstration that was held out, by name, as it was then."""
        return {row["name"]: row["log_likelihood"] for row in self.metrics["valid"]}

    def was_held_out(self, name: str, log_likelihood: float) -> bool:
        """Whether a demonstration is one of those that were held out: the same name, and as likely as it was then."""
        return bool(np.isclose(self.held_out.get(name, np.nan), log_likelihood, rtol=TOLERANCE, atol=TOLERANCE))

    def infer(self, demos: Iterable[Demonstration]) -> Iterator[Inferred]:
        """What the model says of demonstrations, in pieces that fit into memory, in their order.

        >>> for piece in fit.infer(demos):
        ...     print(piece.log_likelihood.shape, piece.posterior.u[0].shape, piece.path.choices[0].shape)
        (6,) torch.Size([6, 10, 3]) torch.Size([6, 10])

        :param demos: :class:`~ddco_pyro.Demonstrations`, or single ones that are read while this goes on.
        :raises DemonstrationsError: there are none, or a number is too large for networks.
        """
        return infer(self.hierarchy, demos)

    def log_likelihood(self, demos: Iterable[Demonstration]) -> np.ndarray:
        """log p(ξ) of each demonstration, nats, [N]; the density is in the control's own units.

        >>> fit.log_likelihood(demos).shape
        (6,)
        """
        return np.concatenate([piece.log_likelihood for piece in self.infer(demos)])

    def posterior(self, demos: Iterable[Demonstration]) -> Posterior:
        """u, v and w of §4.1 for every level, each [N, T, 1 + k] with control as choice 0.

        >>> (u,) = fit.posterior(demos).u
        >>> u.shape, float(u[0, 0].sum().round(decimals=6))
        (torch.Size([6, 10, 3]), 1.0)
        """
        parts = [piece.posterior for piece in self.infer(demos)]
        return Posterior(
            *(tuple(_stacked(level, 0.0) for level in zip(*kind, strict=True)) for kind in zip(*parts, strict=True))
        )

    def segment(self, demos: Iterable[Demonstration]) -> tuple[np.ndarray, ...]:
        """Choices of the most likely path, a [N, T] for each level, lowest first; -1 past a demonstration's end.

        >>> (options,) = fit.segment(demos)
        >>> options.shape, sorted(set(options[options >= 0].tolist()) - {1, 2})
        ((6, 10), [])
        """
        parts = [piece.path.choices for piece in self.infer(demos)]
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


HIERARCHY = "ddco"
"""What a hierarchy whose options last is called in tables."""


def model_name(spec: Spec) -> str:
    """``ddco``, or what a baseline of this model is called (:attr:`~ddco_pyro.spec.BaselineSpec.name`)."""
    if spec.hierarchy is None:
        assert spec.baseline is not None  # a spec has one or the other
        return spec.baseline.name
    memoryless = [level.name for level in spec.hierarchy.levels if not level.lasts]
    if not memoryless:
        return HIERARCHY
    return "_".join(("mixture", *(memoryless if len(memoryless) < len(spec.hierarchy.levels) else ())))


def load(folder: str | Path, allow_code: bool = False) -> Fit:
    """The fit in a run folder.

    >>> again = ddco_pyro.load("runs/mine")
    >>> again.metrics == fit.metrics, (again.log_likelihood(demos) == fit.log_likelihood(demos)).all()
    (True, np.True_)

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
        hierarchy = _read_model(spec, folder / "model.safetensors").eval()
    except BadInput:
        raise
    except (KeyError, ValueError, RuntimeError) as error:
        raise RunError(f"{folder / 'model.safetensors'}: is of another spec than spec.yaml; {refit(folder)}") from error
    counts = [level.count for level in spec.hierarchy.levels] if spec.hierarchy else []
    return Fit(spec, hierarchy, read_metrics(folder, counts), folder)


def _read_model(spec: Spec, path: Path) -> Hierarchy:
    tensors, metadata = read_tensors(path, refit(path.parent))
    wrong = [name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())]
    if wrong:
        raise Damaged(path, f"{wrong[0]} has numbers that are NaN or infinite", refit(path.parent))
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
