"""Evaluation of a fit: log-likelihoods, differences to baselines, use of options, agreement with labels."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import one_hot

from ddco_pyro.data.controls import measure
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import Failed
from ddco_pyro.evaluation.agreement import agreement, confusion, of_equal_lengths
from ddco_pyro.evaluation.branch_use import branch_use
from ddco_pyro.evaluation.inferred import Inferred, infer
from ddco_pyro.evaluation.options import divergences, option_use, segments_of
from ddco_pyro.fitting.draws import matched
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.fitting.names import matched as matched_names
from ddco_pyro.inference import Posterior
from ddco_pyro.inference.posteriors import log_predictive
from ddco_pyro.metrics import (
    Agreement,
    Alike,
    Below,
    ByDimension,
    Compared,
    Counts,
    Dimensions,
    Engines,
    Finite,
    HeldOut,
    Listed,
    Marginal,
    Metrics,
    Parts,
    Segments,
    TrainedLabels,
    Use,
)
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.spec import LearnedStd, Spec, with_overrides
from ddco_pyro.statistics import paired, worth
from ddco_pyro.training.data import tuning_split
from ddco_pyro.training.labels import choices, used
from ddco_pyro.training.networks import Dimensions as Sizes
from ddco_pyro.training.networks import parameters
from ddco_pyro.training.restarts import Trainer, train_model

PACKAGES = ("ddco-pyro", "torch", "pyro-ppl", "numpy", "dm-control", "mujoco", "ompl", "scikit-learn")
"""Packages whose versions are in ``metrics.json``, where they are installed."""


@dataclass(frozen=True)
class _Part:
    """A model on a part of the demonstrations.

    :param values: log p(ξ) of each demonstration, nats, [N].
    :param dimensions: the parts of the same that each control dimension in the model has, [N, A'].
    :param options: and the part that the choice of options has, [N] (:func:`decompose`).
    :param segments: the most likely options [T] of each demonstration, for each level.
    :param recognised: the options that a recogniser alone finds, [T] of each demonstration; else empty.
    """

    values: np.ndarray
    dimensions: Tensor
    options: Tensor
    segments: list[list[np.ndarray]]
    recognised: list[np.ndarray]

    @classmethod
    def of(cls, fit: Fit, demos: Demonstrations, held_out: bool = False) -> _Part:
        values, parts, paths, recognised = [], [], [], list[np.ndarray]()
        renumbered = held_out and fit.without and fit.hierarchy.depth
        choices = _as_own(fit, demos) if renumbered else lambda piece: piece.path.choices
        for piece in fit.infer(demos, held_out):
            values.append(_finite(fit, piece))
            parts.append(decompose(piece.outputs, piece.batch))
            paths.append(choices(piece))
            if piece.recognised is not None:
                rows = zip(piece.recognised.numpy(), piece.lengths, strict=True)
                recognised += [row[:steps] for row, steps in rows]
        segments = [[row[row >= 0].numpy() for h in level for row in h] for level in zip(*paths, strict=True)]
        dimensions, options = (torch.cat(column) for column in zip(*parts, strict=True))
        return cls(np.concatenate(values), dimensions, options, segments, recognised)


def decompose(outputs: Outputs, batch: Batch) -> tuple[Tensor, Tensor]:
    """log p(ξ) of N demonstrations in parts, float64 nats in the control's own units.

    p_t is the belief over options before the control of step t, q_t the belief after it:

        log p(ξ) = Σ_t log Σ_h p_t(h) π_h(a_t) = Σ_d Σ_t E_q_t[log π(a_td)] − Σ_t KL(q_t ‖ p_t).

    :returns: Σ_t E_q_t[log π(a_td)] of the control dimensions in the model, [N, A'], and −Σ_t KL(q_t ‖ p_t),
        which is at most 0, and 0 without options, [N].
    """
    exact, actions = outputs.map(lambda tensor: tensor.detach().double()), batch.actions.double()
    tables = exact.tables(actions)
    control = tuple(table.detach().requires_grad_() for table in tables.control)
    value = log_predictive(replace(tables, control=control), batch.lengths)
    actors = torch.autograd.grad(value.sum(), control)
    with torch.no_grad():
        value = value.detach()
        alive = batch.alive[..., None, None]
        dimensions = sum(
            torch.where(alive, weight.unsqueeze(-1) * emission.by_dimension(actions), 0.0).sum((1, 2))
            for emission, weight in zip(exact.emissions, actors, strict=True)
            if emission is not None
        )
        assert isinstance(dimensions, Tensor)  # the lowest level emits the control
        return dimensions, value - dimensions.sum(-1) if tables.depth else torch.zeros_like(value)


def _as_own(fit: Fit, demos: Demonstrations) -> Callable[[Inferred], tuple[Tensor, ...]]:
    """The most likely choices of a piece by the model without its demonstration, numbered as a fit's own.

    Options are matched so that both models agree on as many steps of the other demonstrations as possible.
    """
    sizes = [1 + level.count for level in fit.hierarchy.option_levels()]
    own = _active(infer(fit.hierarchy, demos), sizes)

    def renumbered(piece: Inferred) -> tuple[Tensor, ...]:
        others = demos.select([name for name in demos.names if name not in piece.names])
        theirs = _active(infer(piece.hierarchy, others), sizes)
        orders = matched([own[name] for name in theirs], [*theirs.values()], sizes)
        pairs = zip(piece.path.choices, orders, strict=True)
        return tuple(torch.where(h < 0, h, torch.from_numpy(order)[h.clamp(min=0)]) for h, order in pairs)

    return renumbered


def _active(pieces: Iterable[Inferred], sizes: Sequence[int]) -> dict[str, Tensor]:
    """Whether each choice is active on a demonstration's most likely path, by name, [T, Σ (1 + k_d)]."""
    return {
        name: torch.cat(
            [
                one_hot(level[row, : piece.lengths[row]].long(), size).double()
                for level, size in zip(piece.path.choices, sizes, strict=True)
            ],
            dim=1,
        )
        for piece in pieces
        for row, name in enumerate(piece.names)
    }


def _finite(fit: Fit, piece: Inferred) -> np.ndarray:
    """log p(ξ) of each demonstration, nats, [N].

    :raises Failed: one is NaN or infinite.
    """
    for name, value in zip(piece.names, piece.log_likelihood, strict=True):
        if not np.isfinite(value):
            raise Failed(
                f"{fit.place}: the log-likelihood of {name} under the fitted model is {value}; look at its "
                "values (ddco-pyro inspect), lower training.optimizer.lr, or leave it out "
                "(demonstrations.exclude)"
            )
    return piece.log_likelihood


def _versions() -> dict[str, str]:
    distributions = importlib.metadata.distributions
    installed = {package: next(iter(distributions(name=package)), None) for package in PACKAGES}
    return {package: found.version for package, found in installed.items() if found}


def evaluate(
    fitted: Fit,
    trained: Trainer,
    size: Sizes,
    parts: dict[str, Demonstrations],
    contained: Collection[str],
    whole: bool,
) -> Metrics:
    """The evaluation of a model.

    It has the log-likelihood in nats per step of each part of the data and of each demonstration, and the
    paired difference to every baseline. A hierarchy also has its options' use, divergences and agreement.

    :param parts: training (``train``) and held-out (``valid``) demonstrations.
    :param contained: names of the mixtures among the baselines that the model contains.
    :param whole: whether it is a model with its baselines, which has a marginal and names of options.
    :raises Failed: a log-likelihood is NaN or infinite.
    """
    demos, scaling, training = fitted.demonstrations, fitted.hierarchy.scaling, trained.summary
    ours = {name: _Part.of(fitted, part, name == "valid") for name, part in parts.items()}
    by_method = {fitted.name: {name: part.values for name, part in ours.items()}}
    for method, fit in fitted.baselines.items():
        by_method[method] = {
            name: np.concatenate([_finite(fit, piece) for piece in fit.infer(part, name == "valid")])
            for name, part in parts.items()
        }
    values, valid, depth = by_method[fitted.name], parts.get("valid"), fitted.hierarchy.depth
    per_step = {name: float(v.sum() / sum(parts[name].lengths)) for name, v in values.items()}
    by_dimension = {name: _by_dimension(fitted, part, parts[name]) for name, part in ours.items()}
    held_out = {} if valid is None else {name: each["valid"] for name, each in by_method.items()}
    lengths = np.array([] if valid is None else valid.lengths, dtype=float)
    options, segments, alike = _options(fitted, demos) if depth else ([], [], [])
    labels, train = _trained_labels(fitted, parts["train"], ours["train"]), len(trained.data.train)
    named = (
        matched_names(fitted.spec, parts["train"], ours["train"].segments, labels) if depth and whole else []
    )
    counts = Counts(
        train=train,
        tune=len(parts["train"]) - train,
        valid=len(valid or ()),
        left_out=bool(fitted.without),
        supervisor=json.loads(str(demos.attributes.get("supervisor", "{}"))),  # a collected file has it
    )
    return Metrics(
        model=fitted.name,
        log_likelihood_per_step=Parts[Finite](train=per_step["train"], valid=per_step.get("valid")),
        log_likelihood_by_dimension=ByDimension(train=by_dimension["train"], valid=by_dimension.get("valid")),
        valid=[
            HeldOut(name=demo.name, steps=len(demo), log_likelihood=float(value))
            for demo, value in zip(valid or (), values.get("valid", ()), strict=True)
        ],
        demonstrations_by_likelihood=_worst_first(fitted.name, parts, by_method),
        comparison={
            name: Compared(
                log_likelihood_per_step=fit.metrics.log_likelihood_per_step,
                difference=paired(held_out[fitted.name], held_out[name], lengths),
                parameters=fit.metrics.parameters,
                training=fit.metrics.training,
            )
            for name, fit in fitted.baselines.items()
        },
        below={
            name: Below(
                objective=fitted.baselines[name].metrics.training.objective - training["objective"],
                nats=fitted.baselines[name].metrics.log_likelihood_per_step.train - per_step["train"],
            )
            for name in contained
        },
        marginal=marginal(fitted.spec, size, parts) if whole else None,
        worth=worth(fitted.name, held_out, partial(paired, lengths=lengths)),
        branches=branch_use(fitted.hierarchy, infer(fitted.hierarchy, valid or demos)),
        options=options,
        segments=segments,
        divergences=alike,
        agreement=_agreement(fitted, ours, parts),
        control_frequency=demos.frequency,
        trained_labels=labels,
        named_by_labels=named,
        engine_check=Engines(**trained.check._asdict()),
        demonstrations=counts,
        measure=measure(scaling.parts),
        control_dimensions=[dimension.as_data() for dimension in size.control],  # type: ignore[misc]  # validated
        parameters=parameters(fitted.hierarchy),
        training=training,  # type: ignore[arg-type]  # validated
        seconds={},
        versions=_versions(),
    )


CONSTANT: Mapping[str, Any] = {
    "hierarchy": None,
    "baseline": {"kind": "flat", "policy": {"network": "constant"}},
    "compare_with": [],
    "observations": ["nothing"],
    "control.power": 1,
    "control.relative_to": None,
    "training": {"optimizer": {"name": "em"}, "tune_fraction": 0, "starts": ["random"]},
    "report": {},
    "selection.grid": {},
}
"""What makes a spec one of a policy that reads no observation."""


def marginal(spec: Spec, size: Sizes, parts: Mapping[str, Demonstrations]) -> Marginal | None:
    """The density of the control without observations, of the same kinds, fitted to those that train.

    :param parts: as of :func:`evaluate`.
    :returns: None where no demonstration is held out.
    """
    if "valid" not in parts:
        return None
    own = {"control.std": spec.control.std} | {
        f"control.parts.{n}.std": p.std for n, p in enumerate(spec.control.parts)
    }
    learned = LearnedStd(learn=True)
    stds = {path: std if isinstance(std, LearnedStd) else learned for path, std in own.items() if std}
    changes = {path: {"learn": True, "floor": std.floor} for path, std in stds.items()}
    unseen = partial(_unseen, relative_to=spec.control.relative_to)
    train = unseen(tuning_split(spec, size, parts["train"])[0])
    alike = replace(size, shapes=train.observation_shapes, steps=max(train.lengths))  # of the same kinds
    model = train_model(with_overrides(spec, {**CONSTANT, **changes}), alike, train).hierarchy
    values = {}
    for name, part in parts.items():
        total = sum(piece.log_likelihood.sum() for piece in infer(model, unseen(part)))
        values[name] = float(total / sum(part.lengths))
    return Marginal(**values, controls=len(model.scaling.varying))


def _unseen(demos: Demonstrations, relative_to: str | None) -> Demonstrations:
    """Demonstrations with a constant as their observations, and what options are of as their controls."""
    each = ((one, one.controls(relative_to)) for one in demos)
    nothing = (
        replace(one, observations={"nothing": np.zeros((len(one), 1))}, actions=own) for one, own in each
    )
    return Demonstrations(tuple(nothing))


def _options(fit: Fit, demos: Demonstrations) -> tuple[list[list[Use]], list[Segments], list[list[Alike]]]:
    """The use, the segments and the divergences of options."""
    sums: list[Posterior] = []
    paths: list[list[np.ndarray]] = [[] for _ in fit.names]

    def pieces() -> Iterator[tuple[Outputs, Posterior]]:
        for piece in infer(fit.hierarchy, demos):
            for path, level in zip(paths, piece.path.choices, strict=True):
                path += list(level.numpy())
            sums.append(Posterior(*(tuple(h.sum(1, keepdim=True) for h in kind) for kind in piece.posterior)))
            yield piece.outputs, piece.posterior

    alike = divergences(pieces())
    whole = Posterior(*(tuple(map(torch.cat, zip(*kind, strict=True))) for kind in zip(*sums, strict=True)))
    return option_use(whole, paths), [segments_of(level, demos.frequency) for level in paths], alike


def _worst_first(
    ours: str, parts: dict[str, Demonstrations], by_method: dict[str, dict[str, np.ndarray]]
) -> list[Listed]:
    """Every demonstration with its part of the data and its log-likelihood per step under each method.

    The least likely demonstration under the method ``ours`` comes first.
    """
    rows = []
    for part, demos in parts.items():
        for row, demo in enumerate(demos):
            nats = {name: float(values[part][row]) / len(demo) for name, values in by_method.items()}
            rows.append(Listed(name=demo.name, part=part, steps=len(demo), log_likelihood_per_step=nats))
    return sorted(rows, key=lambda row: row.log_likelihood_per_step[ours])


def _by_dimension(fit: Fit, part: _Part, demos: Demonstrations) -> Dimensions:
    """The contributions of each control dimension, and of options, to the log-likelihood per step.

    Constant dimensions, which the model leaves out, have None.
    """
    scaling, steps = fit.hierarchy.scaling, sum(demos.lengths)
    values: list[float | None] = [None] * scaling.size
    for dimension, value in zip(scaling.varying.tolist(), part.dimensions.sum(0).tolist(), strict=True):
        values[dimension] = value / steps
    return Dimensions(by_dimension=values, options=float(part.options.sum()) / steps)


def _agreement(fit: Fit, ours: Mapping[str, _Part], parts: Mapping[str, Demonstrations]) -> Agreement | None:
    """All measures of each level's segments against its labels, and the confusion matrix of the last part.

    None where the spec names no labels.
    """
    levels, recogniser = fit.hierarchy.option_levels(), fit.hierarchy.recogniser
    names = fit.spec.demonstrations.labels_by_level(len(levels)) if levels else ()
    found: dict[str, Any] = {"labels": list(names), "recogniser": {}}
    for part, demos in parts.items():
        truth, tasks = [[demo.labels[name] for demo in demos] for name in names], demos.tasks
        pairs = list(zip(ours[part].segments, truth, strict=False))
        equal = zip(truth, (level.count for level in levels), ours[part].segments, strict=False)
        found[part] = [agreement(*pair, tasks) for pair in pairs]
        found["confusion"] = [confusion(*pair) for pair in pairs]
        found[f"equal_{part}"] = [of_equal_lengths(*each, tasks) for each in equal]
        if names and recogniser is not None:
            found["recogniser"][part] = agreement(ours[part].recognised, truth[recogniser.level - 1], tasks)
    return Agreement(**found) if names else None


def _trained_labels(fit: Fit, train: Demonstrations, ours: _Part) -> TrainedLabels | None:
    """The labels that a fit used in training (``training.labels``).

    ``agreement`` is the fraction of the labelled steps whose most likely option, inferred without labels, is
    the label's.
    """
    labels, own = used(fit.spec, fit.demonstrations), fit.spec.training.labels
    if labels is None or own is None:
        return None
    known = choices(train, own.source, labels.values, labels.demonstrations).numpy()
    pairs = zip(ours.segments[labels.level - 1], known, strict=True)
    agree = [(found == label[: len(found)])[label[: len(found)] >= 0] for found, label in pairs]
    return TrainedLabels(
        level=own.level,
        labels=own.source,
        values=list(labels.values),
        demonstrations=list(labels.demonstrations),
        agreement=float(np.concatenate(agree).mean()),
    )
