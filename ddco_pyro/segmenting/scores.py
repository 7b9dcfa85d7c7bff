"""How well a run's options, and baselines beside them, agree with the labels of demonstrations that were segmented."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ddco_pyro.data.sources import Source
from ddco_pyro.drawing.scores import rows
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.segmenting import Segmented, Segments, demonstrations
from ddco_pyro.segmenting.baselines import BASELINES, segment
from ddco_pyro.training.data import parts

Scores = Mapping[str, Any] | None


@dataclass(frozen=True)
class LevelScores:
    """Measures of a level with the labels so named: of its ``options``, and of ``baselines`` by name, each in words."""

    labels: str
    options: dict[str, Scores]
    baselines: dict[str, Scores]

    def rows(self) -> list[list[str]]:
        """As rows of text, under :data:`ddco_pyro.drawing.scores.HEAD`."""
        return [row for name, scores in (self.options | self.baselines).items() for row in rows(name, scores)]


def level_scores(segmented: Segmented, baselines: Mapping[str, dict[str, Scores]]) -> dict[str, LevelScores]:
    """Measures of each level of whose labels any are there, by its name.

    :param baselines: by level, those of :func:`baseline_scores`.
    """
    scores = {}
    for level, truth in segmented.truth.items():
        if groups := _groups(segmented, level):
            options: dict[str, Scores] = {
                f"options, {name}": _of_options(group, level, truth) for name, group in groups.items()
            }
            scores[level] = LevelScores(truth, options, baselines.get(level, {}))
    return scores


def baseline_scores(fit: Fit, source: Source, segmented: Segmented, gripper: int = -1) -> dict[str, dict[str, Scores]]:
    """Measures of every baseline by level: with as many kinds as the level has options, fitted to the run's training
    demonstrations, on the same ones of the source as the first row of the level's own.

    :raises BadInput: the source has no labels with which the run's spec compares.
    """
    train = parts(fit.spec, fit.demonstrations)["train"]
    scores: dict[str, dict[str, Scores]] = {}
    for level, truth in segmented.truth.items():
        for name, group in list(_groups(segmented, level).items())[:1]:
            demos = demonstrations(source, [demo.name for demo in group], fit)
            labels = [demo.labels[truth] for demo in group]
            arguments = (train, demos, segmented.counts[level], fit.spec.seed, fit.spec.observations, gripper)
            scores[level] = {
                f"{words}, {name}": agreement(segment(baseline, *arguments), labels)
                for baseline, words in BASELINES.items()
            }
    if not scores:
        named = ", ".join(f"labels/{name}" for name in fit.spec.demonstrations.label_names)
        missing = f"the demonstrations have no {named}" if named else "the run's spec has no demonstrations.labels"
        raise BadInput(f"--baselines: {missing}, with which baselines are compared")
    return scores


def _groups(segmented: Segmented, level: str) -> dict[str, list[Segments]]:
    """Demonstrations that have the level's labels, by part; the held-out ones first where there are any."""
    labelled = [demo for demo in segmented.segments if segmented.truth[level] in demo.labels]
    held_out = [demo for demo in labelled if demo.held_out]
    others = [demo for demo in labelled if not demo.held_out]
    named = {f"{len(held_out)} held out": held_out, f"{len(others)} {'others' if held_out else 'in all'}": others}
    return {name: group for name, group in named.items() if group}


def _of_options(group: Sequence[Segments], level: str, truth: str) -> Scores:
    options: list[np.ndarray] = [demo.levels[level].options for demo in group]
    return agreement(options, [demo.labels[truth] for demo in group])
