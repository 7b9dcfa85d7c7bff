"""The section that shows which option is active when: posteriors, segments, trajectories in space, timing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.drawing.pictures import Picture, keep
from ddco_pyro.evaluation.schema import option_labels
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.report import plot_posterior, plot_rows, plot_timing, plot_trajectories, tables
from ddco_pyro.report.activity import Activity
from ddco_pyro.report.sections import Figures, quoted

EXAMPLES = 4
"""Demonstrations whose posterior is shown step by step."""


def options(fit: Fit, demos: Demonstrations, activity: Activity, metrics: Mapping[str, Any]) -> Figures:
    """Which option is active when."""
    assert fit.spec.hierarchy is not None  # or there is no activity
    pictures = [
        _posteriors(fit, demos, activity, metrics),
        _rows(fit, demos, activity),
        _trajectories(fit, demos, activity),
        _timing(fit, demos, activity),
    ]
    names = [level.name for level in fit.spec.hierarchy.levels]
    number = sum(metrics["demonstrations"][part] for part in PARTS)
    table = tables.option_use(names, metrics["options"], number, option_labels(metrics))
    several = "Each level numbers its own options: equal colours in two levels mean nothing."
    text = several if len(names) > 1 else ""
    return Figures([picture for picture in pictures if picture is not None], table, text)


PARTS = ("train", "tune", "valid")
CHOSEN = (
    "Of those with three numbers or more it moves the most within demonstrations; report.trajectory in the spec names "
    "another. "
)


def _posteriors(fit: Fit, demos: Demonstrations, activity: Activity, metrics: Mapping[str, Any]) -> Picture:
    held_out = [demo["name"] for demo in metrics["valid"] if demo["name"] in demos.names]
    names = (held_out or list(demos.names))[:EXAMPLES]
    examples = [
        plot_posterior.Example(demos.names.index(name), name, _labels(fit, demos[demos.names.index(name)]))
        for name in names
    ]
    caption = (
        f"Probability of each option at each step of {len(names)} {'held-out ' if held_out else ''}demonstrations, "
        "given the whole demonstration (u in the paper), stacked; under it the path: the most likely sequence of "
        "options."
    )
    if examples[0].labels:
        caption += f" Boxes: ground-truth {quoted(examples[0].labels)}."
    path = fit.run_folder / "figures" / "posterior.png"
    alt = f"Stacked probabilities of the options over time in {', '.join(names)}"
    return keep(plot_posterior.draw(activity, examples), path, alt, caption)


def _rows(fit: Fit, demos: Demonstrations, activity: Activity) -> Picture:
    labels = [_labels(fit, demo) for demo in demos]
    known = {name: [own[name] for own in labels] for name in labels[0]}
    caption = (
        f"Most likely options of all {len(demos)} demonstrations, one row each, sorted by length, then by when the "
        "option first changes."
    )
    if known:
        caption += " Ground-truth labels in shades of grey."
    alt = f"Rows of colour: the most likely option at each step of {len(demos)} demonstrations"
    return keep(plot_rows.draw(activity, known), fit.run_folder / "figures" / "segments.png", alt, caption)


def _trajectories(fit: Fit, demos: Demonstrations, activity: Activity) -> Picture | None:
    named = fit.spec.report.trajectory
    key = named or plot_trajectories.position_key(demos)
    if key is None:
        return None
    figure = plot_trajectories.draw(activity, plot_trajectories.positions(demos, key), key)
    shown = min(len(demos), plot_trajectories.MOST_TRAJECTORIES)
    caption = (
        f"{shown} demonstrations in space, coloured by the most likely option: first three numbers of observation "
        f"“{key}”, in its own units. {'' if named else CHOSEN}Circles: first steps. Seen from where the trajectories "
        "spread the most."
    )
    alt = f"Trajectories of {key} in three dimensions, coloured by option"
    return keep(figure, fit.run_folder / "figures" / "trajectories.png", alt, caption)


def _timing(fit: Fit, demos: Demonstrations, activity: Activity) -> Picture:
    caption = (
        "Left: mean probability of each option over all demonstrations. Right: how likely an active option is to end "
        "at a step (its termination condition, ψ in the paper); left out where it is hardly ever active before."
    )
    if len(activity.levels) > 1:
        caption += " Above the lowest level an option can end only where the one below it ends."
    alt = f"Share of each option and termination probabilities over time, {len(demos)} demonstrations"
    return keep(plot_timing.draw(activity), fit.run_folder / "figures" / "timing.png", alt, caption)


def _labels(fit: Fit, demo: Demonstration) -> dict[str, Any]:
    return {name: demo.labels[name] for name in fit.spec.demonstrations.label_names if name in demo.labels}
