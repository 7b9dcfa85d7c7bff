"""When options are active and when they terminate, over all demonstrations."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ddco_pyro.drawing.colours import option_colour
from ddco_pyro.drawing.pictures import blank
from ddco_pyro.report.activity import Activity, Bins, LevelActivity, bins
from ddco_pyro.report.strips import legend

LEAST_SHARE = 0.01
"""A termination is shown where its option is active in at least this part of the demonstrations."""


def draw(activity: Activity) -> Figure:
    """For each level, the highest first: share of each choice and termination probability of each option, over time."""
    gathered = bins(activity.lengths)
    figure = blank(0.5 + 2.1 * len(activity.levels))
    panels = figure.subplots(len(activity.levels), 2, sharex=True, squeeze=False)
    for (left, right), level in zip(panels, reversed(activity.levels), strict=True):
        _shares(left, level, gathered)
        _terminations(right, level, gathered)
        left.set_title(f"share of each choice, level “{level.name}”")
        right.set_title(f"probability of ending, level “{level.name}”")
    for axes in panels[-1]:
        axes.set_xlabel(gathered.axis)
    choices = sorted({choice for level in activity.levels for choice in level.choices})
    figure.legend(handles=legend(choices), loc="outside lower center", ncols=min(len(choices), 11), handlelength=1)
    return figure


def shares(level: LevelActivity, gathered: Bins) -> np.ndarray:
    """Mean of u_t in each bin [B, C]."""
    alive = (gathered.index >= 0).astype(float)
    return np.stack([gathered.mean(level.active[..., c], alive) for c in range(level.active.shape[2])], axis=1)


def terminations(level: LevelActivity, gathered: Bins) -> np.ndarray:
    """Mean of ψ_h(s_t) in each bin [B, k], weighted by u_{t-1}(h): by how likely h is the option that may end at t.

    NaN in bins in which the option is hardly active.
    """
    before = np.zeros_like(level.active[..., 1:])
    before[:, 1:] = level.active[:, :-1, 1:]
    steps = gathered.total(np.ones(gathered.index.shape))
    means = []
    for option in range(before.shape[2]):
        weights = before[..., option]
        mean = gathered.mean(level.termination[..., option], weights)
        means.append(np.where(gathered.total(weights) >= LEAST_SHARE * steps, mean, np.nan))
    return np.stack(means, axis=1)


def _shares(axes: Axes, level: LevelActivity, gathered: Bins) -> None:
    values = shares(level, gathered)
    top = np.cumsum(values, axis=1)
    for choice in range(values.shape[1]):
        lower = top[:, choice] - values[:, choice]
        axes.stairs(top[:, choice], gathered.edges, baseline=lower, fill=True, color=option_colour(choice), linewidth=0)
    axes.set(ylim=(0, 1), xlim=(gathered.edges[0], gathered.edges[-1]), ylabel="share")


def _terminations(axes: Axes, level: LevelActivity, gathered: Bins) -> None:
    middles = (gathered.edges[:-1] + gathered.edges[1:]) / 2
    for option, values in enumerate(terminations(level, gathered).T, start=1):
        axes.plot(middles, values, color=option_colour(option), linewidth=1.5, marker="o", markersize=2.5)
    axes.set(ylim=(-0.02, 1.02), ylabel="probability")
    axes.grid(axis="y", color="#e4e4e4")
