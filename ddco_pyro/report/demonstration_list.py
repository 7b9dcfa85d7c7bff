"""Every demonstration by its log-likelihood, the worst first, and the timelines that the list leads to."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing.words import method, number
from ddco_pyro.evaluation.schema import option_labels
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.report.activity import Activity
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments
from ddco_pyro.segmenting.timeline import Timeline, anchor
from ddco_pyro.segmenting.timeline import timelines as drawn

SHOWN = 20
"""Rows that can be seen without unfolding the rest."""

MOST_BOXES = 20_000
"""Segments in the page, about; ``ddco-pyro segment --html`` makes a page of more."""


@dataclass(frozen=True)
class ListedDemonstration:
    """One row: log-likelihood per step of each method, and the ``anchor`` of its timeline where there is one."""

    name: str
    anchor: str | None
    held_out: bool
    cells: tuple[str, ...]


@dataclass(frozen=True)
class DemonstrationList:
    """The demonstrations, the least likely under the ``model`` first; the first rows, and those that are folded."""

    model: str
    head: tuple[str, ...]
    first: list[ListedDemonstration]
    rest: list[ListedDemonstration]


def listed(metrics: Mapping[str, Any], anchors: Collection[str]) -> DemonstrationList | None:
    """The list in ``metrics.json``; None for runs of before, which have none.

    :param anchors: those of the timelines that are there.
    """
    entries = metrics.get("demonstrations_by_likelihood")
    if not entries:
        return None
    methods = list(entries[0]["log_likelihood_per_step"])
    rows = [
        ListedDemonstration(
            entry["name"], place if (place := anchor(entry["name"])) in anchors else None, entry["part"] == "valid",
            (str(entry["steps"]), *(number(entry["log_likelihood_per_step"][name]) for name in methods)),
        )
        for entry in entries
    ]  # fmt: skip
    head = ("Demonstration", "", "Steps", *map(method, methods))
    return DemonstrationList(method(metrics["model"]), head, rows[:SHOWN], rows[SHOWN:])


def timelines(fit: Fit, demos: Demonstrations, activity: Activity, metrics: Mapping[str, Any]) -> list[Timeline]:
    """The segments of the listed demonstrations, in the order of the list."""
    rows = metrics.get("demonstrations_by_likelihood", ())
    places = {name: row for row, name in enumerate(demos.names)}
    known = [entry for entry in rows if entry["name"] in places]
    segments = tuple(_segments(fit, demos, places[entry["name"]], activity, entry) for entry in known)
    counts = {level.name: level.active.shape[2] - 1 for level in activity.levels}
    segmented = Segmented(segments, counts, None, option_labels=option_labels(metrics))
    return drawn(segmented, MOST_BOXES) if segments else []


def _segments(fit: Fit, demos: Demonstrations, row: int, activity: Activity, listed: Mapping[str, Any]) -> Segments:
    demo = demos[row]
    levels = {
        level.name: LevelLabels.of(
            *(array[row, : len(demo)] for array in (level.path, level.ended, level.active)), lasts=level.lasts
        )
        for level in activity.levels
    }
    labels = {name: demo.labels[name] for name in fit.spec.demonstrations.label_names}
    value = listed["log_likelihood_per_step"][fit.name]
    return Segments(demo.name, levels, value, listed["part"] == "valid", labels)
