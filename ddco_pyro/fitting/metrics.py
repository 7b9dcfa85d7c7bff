"""The numbers of a finished fit: likelihood, differences to the baselines, use of options, agreement with labels."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import Failed
from ddco_pyro.fitting import analysis
from ddco_pyro.fitting.fit import Fit


class NotFinite(Failed):
    """A log-likelihood that is no number to report."""


def _log_likelihood(found: Fit, demos: Demonstrations) -> np.ndarray:
    """log p(ξ) of each demonstration, nats, [N].

    :raises NotFinite: one is NaN or infinite.
    """
    values = found.log_likelihood(demos)
    for name, value in zip(demos.names, values, strict=True):
        if not np.isfinite(value):
            raise NotFinite(
                f"{found.folder}: the log-likelihood of {name} under the fitted model is {value}; look at its values "
                "(ddco-pyro inspect), lower training.optimizer.lr, or leave it out (demonstrations.exclude)"
            )
    return values


def evaluate(found: Fit, parts: dict[str, Demonstrations], demos: Demonstrations) -> dict[str, Any]:
    """What ``metrics.json`` says of a model: log-likelihood in nats per step of each part of the data and of each
    demonstration, its paired difference to every baseline, and with options their use, divergences and agreement with
    labels.

    :raises NotFinite: a log-likelihood is NaN or infinite.
    """
    methods = {found.name: found, **found.baselines}
    by_method = {name: {part: _log_likelihood(fit, parts[part]) for part in parts} for name, fit in methods.items()}
    values = by_method[found.name]
    per_step = {name: float(v.sum() / sum(parts[name].lengths)) for name, v in values.items()}
    metrics: dict[str, Any] = {
        "model": found.name,
        "log_likelihood_per_step": {"train": per_step["train"], "valid": per_step.get("valid")},
        "log_likelihood_by_dimension": {
            name: _by_dimension(found, parts[name]) if name in parts else None for name in ("train", "valid")
        },
        "valid": _each(parts["valid"], values["valid"]) if "valid" in parts else [],
        "demonstrations_by_likelihood": _worst_first(found.name, parts, by_method),
        "comparison": {
            name: {
                "log_likelihood_per_step": one.metrics["log_likelihood_per_step"],
                "difference": _difference(values["valid"], by_method[name]["valid"], parts["valid"]),
                "parameters": one.metrics["parameters"],
                "training": one.metrics["training"],
            }
            for name, one in found.baselines.items()
        },
    }
    if found.hierarchy.depth:
        posterior = found.posterior(demos)
        metrics["options"] = analysis.as_rows(analysis.option_use(posterior))
        metrics["divergences"] = found.divergences(demos, posterior)
        if found.spec.demonstrations.labels:
            metrics["agreement"] = _agreement(found, parts)
    return metrics


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


def _by_dimension(found: Fit, demos: Demonstrations) -> dict[str, Any]:
    """What each control dimension (None for constant ones, which are no part of the model) and choosing options add to
    the log-likelihood per step.
    """
    each = found.decompose(demos)
    scaling, steps = found.hierarchy.scaling, sum(demos.lengths)
    values: list[float | None] = [None] * scaling.size
    for dimension, value in zip(scaling.varying.tolist(), each.dimensions.sum(0).tolist(), strict=True):
        values[dimension] = value / steps
    return {"by_dimension": values, "options": float(each.options.sum()) / steps}


def _difference(ours: np.ndarray, theirs: np.ndarray, valid: Demonstrations) -> dict[str, float]:
    return analysis.paired(ours, theirs, np.array(valid.lengths, dtype=float))


def _agreement(found: Fit, parts: dict[str, Demonstrations]) -> dict[str, Any]:
    """NMI of each level's segments with the ground-truth labels."""
    label = found.spec.demonstrations.labels
    assert label is not None  # asked only where there are labels
    scores: dict[str, Any] = {"labels": label}
    for name, part in parts.items():
        truth = [demo.labels[label] for demo in part]
        levels = found.segment(part)
        scores[name] = [
            analysis.agreement([row[: len(demo)] for row, demo in zip(level, part, strict=True)], truth)
            for level in levels
        ]
    return scores


def supervisor(demos: Demonstrations) -> dict[str, Any]:
    """What the demonstrations' file says of how often their supervisor succeeded; nothing where it does not."""
    said = demos.attributes.get("supervisor")
    return {"supervisor": json.loads(str(said))} if said else {}
