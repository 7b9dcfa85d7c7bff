"""The numbers of a finished fit: likelihood, differences to the baselines, use of options, agreement with labels."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import Failed
from ddco_pyro.evaluation import analysis
from ddco_pyro.evaluation.agreement import agreement, confusion
from ddco_pyro.evaluation.branch_use import branch_use
from ddco_pyro.evaluation.inferred import Inferred
from ddco_pyro.evaluation.worth import MIXTURE, mean_run, worth
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.inference import Posterior
from ddco_pyro.inference.decomposition import Decomposition
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.training.labels import choices, used


class NotFinite(Failed):
    """A log-likelihood that is no number to report."""


@dataclass(frozen=True)
class _Part:
    """What a model says of a part of the demonstrations.

    :param values: log p(ξ) of each, nats, [N].
    :param each: that in parts.
    :param segments: the most likely options [T] of each, for each level.
    """

    values: np.ndarray
    each: Decomposition
    segments: list[list[np.ndarray]]

    @classmethod
    def of(cls, fit: Fit, demos: Demonstrations) -> _Part:
        values, parts, paths = [], [], []
        for piece in fit.infer(demos):
            values.append(_finite(fit, piece))
            parts.append(piece.decomposition)
            paths.append(piece.path.choices)
        segments = [[row[row >= 0].numpy() for h in level for row in h] for level in zip(*paths, strict=True)]
        return cls(np.concatenate(values), Decomposition.joined(parts), segments)


def _finite(fit: Fit, piece: Inferred) -> np.ndarray:
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


def evaluate(fitted: Fit, parts: dict[str, Demonstrations], demos: Demonstrations) -> dict[str, Any]:
    """What ``metrics.json`` says of a model: log-likelihood in nats per step of each part of the data and of each
    demonstration, its paired difference to every baseline, and with options their use, divergences and agreement with
    labels.

    :raises NotFinite: a log-likelihood is NaN or infinite.
    """
    ours = {name: _Part.of(fitted, part) for name, part in parts.items()}
    by_method = {fitted.name: {name: part.values for name, part in ours.items()}}
    for method, fit in fitted.baselines.items():
        by_method[method] = {
            name: np.concatenate([_finite(fit, piece) for piece in fit.infer(part)]) for name, part in parts.items()
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
    if uses := branch_use(fitted.hierarchy, fitted.infer(parts.get("valid", demos))):
        metrics["branches"] = uses
    if fitted.hierarchy.depth:
        metrics |= _options(fitted, demos)
        if names := fitted.spec.demonstrations.labels_by_level(fitted.hierarchy.depth):
            metrics["agreement"] = _agreement(names, ours, parts)
    return metrics


def _worth(
    fit: Fit, by_method: Mapping[str, dict[str, np.ndarray]], ours: _Part, valid: Demonstrations
) -> dict[str, Any]:
    """What several experts and options that last are worth on held-out demonstrations; nothing without a mixture.

    ``steps_in_a_row`` compares, level by level, how long options stay active with how long the mixture keeps to one
    expert.
    """
    found = worth(fit.name, {name: values["valid"] for name, values in by_method.items()}, valid.lengths)
    if not found:
        return {}
    pairs = zip(ours.segments, _Part.of(fit.baselines[MIXTURE], valid).segments, strict=True)
    rows = [{"options": mean_run(own), MIXTURE: mean_run(mixture)} for own, mixture in pairs]
    return {"worth": found | {"steps_in_a_row": rows}}


def _options(fit: Fit, demos: Demonstrations) -> dict[str, Any]:
    """How options are used, and how differently they act."""
    sums: list[Posterior] = []

    def pieces() -> Iterator[tuple[Outputs, Posterior]]:
        for piece in fit.infer(demos):
            sums.append(Posterior(*(tuple(h.sum(1, keepdim=True) for h in kind) for kind in piece.posterior)))
            yield piece.outputs, piece.posterior

    divergences = analysis.divergences(pieces())
    whole = Posterior(*(tuple(map(torch.cat, zip(*kind, strict=True))) for kind in zip(*sums, strict=True)))
    return {"options": analysis.as_rows(analysis.option_use(whole)), "divergences": divergences}


def _each(demos: Demonstrations, values: np.ndarray) -> list[dict[str, Any]]:
    return [
        {"name": demo.name, "steps": len(demo), "log_likelihood": float(value)}
        for demo, value in zip(demos, values, strict=True)
    ]


def _worst_first(
    ours: str, parts: dict[str, Demonstrations], by_method: dict[str, dict[str, np.ndarray]]
) -> list[dict[str, Any]]:
    """Every demonstration with its part of the data and its log-likelihood per step under each method, by method; the
    least likely under the method ``ours`` first.
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


def _by_dimension(fit: Fit, each: Decomposition, demos: Demonstrations) -> dict[str, Any]:
    """What each control dimension (None for constant ones, which are no part of the model) and choosing options add to
    the log-likelihood per step.
    """
    scaling, steps = fit.hierarchy.scaling, sum(demos.lengths)
    values: list[float | None] = [None] * scaling.size
    for dimension, value in zip(scaling.varying.tolist(), each.dimensions.sum(0).tolist(), strict=True):
        values[dimension] = value / steps
    return {"by_dimension": values, "options": float(each.options.sum()) / steps}


def _difference(ours: np.ndarray, theirs: np.ndarray, valid: Demonstrations) -> dict[str, float]:
    return analysis.paired(ours, theirs, np.array(valid.lengths, dtype=float))


def _agreement(names: tuple[str, ...], ours: dict[str, _Part], parts: dict[str, Demonstrations]) -> dict[str, Any]:
    """All measures of each level's segments with its ground-truth labels, and in which options the steps of each label
    lie, held out where there is such a part.
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
    """What the demonstrations' file says of how often their supervisor succeeded; nothing where it does not."""
    said = demos.attributes.get("supervisor")
    return {"supervisor": json.loads(str(said))} if said else {}


def trained_labels(fit: Fit, demos: Demonstrations) -> dict[str, Any]:
    """What ``metrics.json`` says of the labels that a fit used; nothing where it used none.

    ``agreement`` is the part of the labelled steps whose most likely option, as if they had no label, is the label's.
    """
    labels, own = used(fit.spec, demos), fit.spec.training.labels
    if labels is None or own is None:
        return {}
    labelled = demos.select(labels.demonstrations)
    segments = torch.as_tensor(fit.segment(labelled)[labels.level - 1])
    known = choices(labelled, own.source, labels.values, labelled.names)
    agreement = float((segments == known)[known >= 0].double().mean())
    said = {"level": own.level, "labels": own.source, "values": labels.values, "demonstrations": labels.demonstrations}
    return {"trained_labels": {**said, "agreement": agreement}}
