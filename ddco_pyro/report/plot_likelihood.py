"""Held-out log-likelihood of the methods, and differences on the same demonstrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ddco_pyro.drawing.pictures import FAINT, INK, blank
from ddco_pyro.drawing.words import method


@dataclass(frozen=True)
class Likelihood:
    """One method, in nats per step: on training and held-out demonstrations, and by how much the model is above it.

    :param valid: NaN where nothing was held out.
    :param difference: (mean, standard error); None for the model itself.
    :param each: the difference on each held-out demonstration.
    :param training: what it spent of its budget; None for runs of before.
    """

    name: str
    train: float
    valid: float
    difference: tuple[float, float] | None = None
    each: tuple[float, ...] = ()
    parameters: int | None = None
    training: Mapping[str, Any] | None = None


def likelihoods(metrics: Mapping[str, Any], baselines: Mapping[str, Mapping[str, Any]]) -> list[Likelihood]:
    """The model and what it was compared with, from its ``metrics.json`` and those of its baselines."""
    own = metrics["log_likelihood_per_step"]
    valid = np.nan if own["valid"] is None else own["valid"]
    likelihoods = [Likelihood(metrics["model"], own["train"], valid, **_effort(metrics))]
    for name, other in metrics["comparison"].items():
        values, difference = other["log_likelihood_per_step"], other["difference"]
        each = _each(metrics["valid"], baselines.get(name, {}).get("valid", ()))
        error = difference["standard_error"]
        mean_and_error = (difference["nats_per_step"], np.nan if error is None else error)
        likelihoods.append(Likelihood(name, values["train"], values["valid"], mean_and_error, each, **_effort(other)))
    return likelihoods


def _effort(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: row.get(key) for key in ("parameters", "training")}


def _each(ours: Sequence[Mapping[str, Any]], theirs: Sequence[Mapping[str, Any]]) -> tuple[float, ...]:
    other = {row["name"]: row["log_likelihood"] for row in theirs}
    return tuple((row["log_likelihood"] - other[row["name"]]) / row["steps"] for row in ours if row["name"] in other)


def draw(rows: Sequence[Likelihood]) -> Figure:
    """Panels of dots: log-likelihood of each method and, where there are several, the paired differences."""
    figure = blank(1.25 + 0.36 * len(rows))
    left, *right = figure.subplots(1, min(len(rows), 2), sharey=True, squeeze=False)[0]
    places = np.arange(len(rows))
    left.scatter([row.train for row in rows], places, facecolor="white", edgecolor=INK, label="training", zorder=3)
    left.scatter([row.valid for row in rows], places, color=INK, label="held out", zorder=3)
    left.set(xlabel="log-likelihood (nats per step)", title="Each method")
    left.set_yticks(places, [method(row.name) for row in rows])
    left.set_ylim(len(rows) - 0.4, -0.6)
    left.grid(axis="x", color="#e4e4e4")
    figure.legend(loc="outside lower left", ncols=2)
    for axes in right:
        _differences(axes, rows, places)
    return figure


def _differences(axes: Axes, rows: Sequence[Likelihood], places: np.ndarray) -> None:
    axes.axvline(0, color=FAINT, linewidth=0.8)
    for row, place in zip(rows, places, strict=True):
        if row.difference is not None:
            axes.scatter(row.each, np.full(len(row.each), place), s=14, color=FAINT, alpha=0.5, linewidth=0, zorder=2)
            mean, error = row.difference
            axes.errorbar(mean, place, xerr=None if np.isnan(error) else error, fmt="D", color=INK, capsize=4, zorder=3)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="#e4e4e4")
    axes.set(xlabel="nats per step above that method, held out", title=f"{method(rows[0].name)} minus each baseline")
