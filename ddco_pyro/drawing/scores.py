"""Measures of segments as rows of text, for pages and the console."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ddco_pyro.drawing.words import number

ALONE = {
    "nmi": "NMI",
    "ari": "ARI",
    "boundary_f1_1": "boundary F1 ±1",
    "boundary_f1_3": "±3",
    "boundary_f1_5": "±5",
}
"""Measures that need no matching of options with labels."""

MATCHED = {"accuracy": "accuracy", "iou": "IoU", "f1_10": "F1@10", "f1_25": "@25", "f1_50": "@50", "edit": "edit"}
MATCHINGS = {"matched_globally": "one for all", "matched_per_demonstration": "each its own"}

HEAD = ("Segments", *ALONE.values(), "matching", *MATCHED.values())

EXPLAINED = (
    "All are at most 1, which is perfect. NMI, normalised mutual information, and ARI, adjusted Rand index (0 by "
    "chance), compare the steps, whatever options are called; boundary F1, where segments begin, within so many steps. "
    "For the others each option stands for one label, so that as many steps as possible agree: in all demonstrations "
    "the same (one for all), or anew in each (each its own). Accuracy: steps that agree; IoU: intersection over union, "
    "mean over labels; F1@P: segments that overlap one of their label by P % or more; edit: 1 − edit distance of the "
    "sequences of segments."
)


def rows(name: str, scores: Mapping[str, Any] | None) -> list[list[str]]:
    """A row for each matching; runs of before have the NMI alone.

    :param scores: those of :func:`ddco_pyro.evaluation.agreement.agreement`.
    """
    scores = scores or {}
    alone = [number(scores.get(key)) for key in ALONE]
    matchings = [key for key in MATCHINGS if key in scores] or [""]
    return [
        [
            "" if place else name,
            *([""] * len(alone) if place else alone),
            MATCHINGS.get(key, "–"),
            *(number(scores.get(key, {}).get(measure)) for measure in MATCHED),
        ]
        for place, key in enumerate(matchings)
    ]
