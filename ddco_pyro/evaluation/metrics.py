"""The evaluation of a fit: log-likelihoods, differences to baselines, use of options, agreement with labels."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import Failed
from ddco_pyro.evaluation.agreement import agreement, confusion
from ddco_pyro.evaluation.branch_use import branch_use
from ddco_pyro.evaluation.inferred import Inferred, infer
from ddco_pyro.evaluation.options import as_rows, divergences, option_use
from ddco_pyro.evaluation.worth import MIXTURE, mean_run, paired, worth
from ddco_pyro.inference import Posterior
from ddco_pyro.inference.posteriors import Decomposition
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.spec import Spec
from ddco_pyro.training.labels import choices, used


class NotFinite(Failed):
    """A log-likelihood is NaN or infinite."""


class Fitted(Protocol):
    """A fitted model: what evaluation reads of :class:`ddco_pyro.Fit`."""

    @property
    def name(self) -> str:
        """The name of the model in tables."""

    @property
    def spec(self) -> Spec:
        """The spec of the model."""

    @property
    def hierarchy(self) -> Hierarchy:
        """The trained networks."""

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of a baseline, which is evaluated before its model."""

    @property
    def without(self) -> Mapping[str, Hierarchy]:
        """The model without each demonstration, by its name, which that demonstration is held out from; else empty."""

    @property
    def baselines(self) -> Mapping[str, Any]:
        """The fitted baselines, by name."""


@dataclass(frozen=True)
class _Part:
    """A model on a part of the demonstrations.

    :param values: log p(ξ) of each demonstration, nats, [N].
    :param each: the decomposition of the same.
    :param segments: the most likely options [T] of each demonstration, for each level.
    """

    values: np.ndarray
    each: Decomposition
    segments: list[list[np.ndarray]]

    @classmethod
    def of(cls, fit: Fitted, demos: Demonstrations, held_out: bool = False) -> _Part:
        values, parts, paths = [], [], []
        for piece in _inferred(fit, demos, held_out):
            values.append(_finite(fit, piece))
            parts.append(piece.decomposition)
            paths.append(_named_alike(fit, piece, demos))
        segments = [[row[row >= 0].numpy() for h in level for row in h] for level in zip(*paths, strict=True)]
        return cls(np.concatenate(values), Decomposition.joined(parts), segments)


def _inferred(fit: Fitted, demos: Demonstrations, held_out: bool) -> Iterator[Inferred]:
    """The inference for demonstrations; with ``leave_one_out`` a held-out one is inferred by the model without it."""
    if not (held_out and fit.without):
        yield from infer(fit.hierarchy, demos)
    else:
        for demo in demos:
            yield from infer(fit.without[demo.name], [demo])


def _named_alike(fit: Fitted, piece: Inferred, demos: Demonstrations) -> tuple[Tensor, ...]:
    """The most likely choices of each level, with the options of a model without a demonstration named as the fit's.

    Options are matched so that both models agree on as many steps of the other demonstrations as possible.
    """
    from scipy.optimize import linear_sum_assignment

    choices = piece.path.choices
    if piece.hierarchy is fit.hierarchy:
        return choices
    others = demos.select(name for name in demos.names if name not in piece.names)
    pairs = zip(*(_choices(model, others) for model in (piece.hierarchy, fit.hierarchy)), strict=True)
    matched = []
    for own, (theirs, ours) in zip(choices, pairs, strict=True):
        names = np.arange(max(theirs.max(), ours.max(), own.max()) + 1)
        together = np.zeros((len(names), len(names)))
        np.add.at(together, (theirs, ours), 1)
        names[1:] = 1 + linear_sum_assignment(together[1:, 1:], maximize=True)[1]  # 0 is the control
        matched.append(torch.where(own < 0, own, torch.as_tensor(names)[own.clamp(min=0)]))
    return tuple(matched)


def _choices(model: Hierarchy, demos: Demonstrations) -> Iterator[np.ndarray]:
    """The most likely choice at every step of demonstrations, [steps], for each level."""
    paths = [piece.path.choices for piece in infer(model, demos)]
    for level in zip(*paths, strict=True):
        yield np.concatenate([part[part >= 0].numpy() for part in level])


def _finite(fit: Fitted, piece: Inferred) -> np.ndarray:
    """log p(ξ) of each demonstration, nats, [N].

    :raises NotFinite: one is NaN or infinite.
    """
    for name, value in zip(piece.names, piece.log_likelihood, strict=True):
        if not np.isfinite(value):
            raise NotFinite(
                f"{fit}: the log-likelihood of {name} under the fitted model is {value}; look at its values "
                "(ddco-pyro inspect), lower training.optimizer.lr, or leave it out (demonstrations.exclude)"
            )
    return piece.log_likelihood


def evaluate(fitted: Fitted, parts: dict[str, Demonstrations], demos: Demonstrations) -> dict[str, Any]:
    """The evaluation of a model for ``metrics.json`` (:class:`ddco_pyro.evaluation.schema.Metrics`).

    It has the log-likelihood in nats per step of each part of the data and of each demonstration, and the paired
    difference to every baseline. A hierarchy also has the use, divergences and agreement with labels of its options.

    :param parts: training (``train``) and held-out (``valid``) demonstrations.
    :param demos: all demonstrations.

    :raises NotFinite: a log-likelihood is NaN or infinite.
    """
    ours = {name: _Part.of(fitted, part, name == "valid") for name, part in parts.items()}
    by_method = {fitted.name: {name: part.values for name, part in ours.items()}}
    for method, fit in fitted.baselines.items():
        by_method[method] = {
            name: np.concatenate([_finite(fit, piece) for piece in _inferred(fit, part, name == "valid")])
            for name, part in parts.items()
        }
    values = by_method[fitted.name]
    per_step = {name: float(v.sum() / sum(parts[name].lengths)) for name, v in values.items()}
    metrics: dict[str, Any] = {
        "model": fitted.name,
        "log_likelihood_per_step": {"train": per_step["train"], "valid": per_step.get("valid")},
        "log_likelihood_by_dimension": {
            name: _by_dimension(fitted, ours[name].each, parts[name]) if name in parts else None
            for name in ("train", "valid")
        },
        "valid": _each(parts["valid"], values["valid"]) if "valid" in parts else [],
        "demonstrations_by_likelihood": _worst_first(fitted.name, parts, by_method),
        "comparison": {
            name: {
                "log_likelihood_per_step": fit.metrics["log_likelihood_per_step"],
                "difference": _difference(values["valid"], by_method[name]["valid"], parts["valid"]),
                "parameters": fit.metrics["parameters"],
                "training": fit.metrics["training"],
            }
            for name, fit in fitted.baselines.items()
        },
    }
    if "valid" in parts:
        metrics |= _worth(fitted, by_method, ours["valid"], parts["valid"])
    if uses := branch_use(fitted.hierarchy, infer(fitted.hierarchy, parts.get("valid", demos))):
        metrics["branches"] = uses
    if fitted.hierarchy.depth:
        metrics |= _options(fitted, demos)
        if names := fitted.spec.demonstrations.labels_by_level(fitted.hierarchy.depth):
            metrics["agreement"] = _agreement(names, ours, parts)
    return metrics | _trained_labels(fitted, demos)


def _worth(
    fit: Fitted, by_method: Mapping[str, dict[str, np.ndarray]], ours: _Part, valid: Demonstrations
) -> dict[str, Any]:
    """The parts of the hierarchy's advantage on held-out demonstrations; empty without a mixture.

    ``steps_in_a_row`` has the mean steps in a row of one option, and of one expert of the mixture, for each level.
    """
    found = worth(fit.name, {name: values["valid"] for name, values in by_method.items()}, valid.lengths)
    if not found:
        return {}
    pairs = zip(ours.segments, _Part.of(fit.baselines[MIXTURE], valid, held_out=True).segments, strict=True)
    rows = [{"options": mean_run(own), MIXTURE: mean_run(mixture)} for own, mixture in pairs]
    return {"worth": found | {"steps_in_a_row": rows}}


def _options(fit: Fitted, demos: Demonstrations) -> dict[str, Any]:
    """The use and the divergences of options."""
    sums: list[Posterior] = []

    def pieces() -> Iterator[tuple[Outputs, Posterior]]:
        for piece in infer(fit.hierarchy, demos):
            sums.append(Posterior(*(tuple(h.sum(1, keepdim=True) for h in kind) for kind in piece.posterior)))
            yield piece.outputs, piece.posterior

    alike = divergences(pieces())
    whole = Posterior(*(tuple(map(torch.cat, zip(*kind, strict=True))) for kind in zip(*sums, strict=True)))
    return {"options": as_rows(option_use(whole)), "divergences": alike}


def _each(demos: Demonstrations, values: np.ndarray) -> list[dict[str, Any]]:
    return [
        {"name": demo.name, "steps": len(demo), "log_likelihood": float(value)}
        for demo, value in zip(demos, values, strict=True)
    ]


def _worst_first(
    ours: str, parts: dict[str, Demonstrations], by_method: dict[str, dict[str, np.ndarray]]
) -> list[dict[str, Any]]:
    """Every demonstration with its part of the data and its log-likelihood per step under each method.

    The least likely demonstration under the method ``ours`` comes first.
    """
    rows = [
        {
            "name": demo.name,
            "part": part,
            "steps": len(demo),
            "log_likelihood_per_step": {
                name: float(values[part][row]) / len(demo) for name, values in by_method.items()
            },
        }
        for part, demos in parts.items()
        for row, demo in enumerate(demos)
    ]
    return sorted(rows, key=lambda row: row["log_likelihood_per_step"][ours])


def _by_dimension(fit: Fitted, each: Decomposition, demos: Demonstrations) -> dict[str, Any]:
    """The contributions of each control dimension, and of the choice of options, to the log-likelihood per step.

    Constant dimensions, which the model leaves out, have None.
    """
    scaling, steps = fit.hierarchy.scaling, sum(demos.lengths)
    values: list[float | None] = [None] * scaling.size
    for dimension, value in zip(scaling.varying.tolist(), each.dimensions.sum(0).tolist(), strict=True):
        values[dimension] = value / steps
    return {"by_dimension": values, "options": float(each.options.sum()) / steps}


def _difference(ours: np.ndarray, theirs: np.ndarray, valid: Demonstrations) -> dict[str, float]:
    return paired(ours, theirs, np.array(valid.lengths, dtype=float))


def _agreement(names: tuple[str, ...], ours: dict[str, _Part], parts: dict[str, Demonstrations]) -> dict[str, Any]:
    """All measures of each level's segments against its labels, and the confusion matrix of the held-out part.

    Without a held-out part the confusion matrix is of the training part.
    """
    scores: dict[str, Any] = {"labels": list(names)}
    for name, part in parts.items():
        pairs = [
            (level, [demo.labels[label] for demo in part])
            for level, label in zip(ours[name].segments, names, strict=True)
        ]
        scores[name] = [agreement(*pair) for pair in pairs]
        scores["confusion"] = [confusion(*pair) for pair in pairs]  # of the last part, which is held out
    return scores


def supervisor(demos: Demonstrations) -> dict[str, Any]:
    """The supervisor's success rate from the file of demonstrations; empty where the file has none."""
    said = demos.attributes.get("supervisor")
    return {"supervisor": json.loads(str(said))} if said else {}


def _trained_labels(fit: Fitted, demos: Demonstrations) -> dict[str, Any]:
    """The labels that a fit used in training (``training.labels``); empty without such labels.

    ``agreement`` is the fraction of the labelled steps whose most likely option, inferred without labels, is the
    label's.
    """
    labels, own = used(fit.spec, demos), fit.spec.training.labels
    if labels is None or own is None:
        return {}
    labelled = demos.select(labels.demonstrations)
    found = _Part.of(fit, labelled).segments[labels.level - 1]
    known = [
        row[: len(demo)]
        for row, demo in zip(
            choices(labelled, own.source, labels.values, labelled.names).numpy(), labelled, strict=True
        )
    ]
    agree = np.concatenate([(ours == label)[label >= 0] for ours, label in zip(found, known, strict=True)])
    about = {"level": own.level, "labels": own.source, "values": labels.values, "demonstrations": labels.demonstrations}
    return {"trained_labels": {**about, "agreement": float(agree.mean())}}
