"""Agreement of segments with ground-truth labels: the measures of options and of baselines, as tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ddco_pyro.drawing.page import Table
from ddco_pyro.drawing.words import duration, number
from ddco_pyro.evaluation.agreement import MATCHED, TOLERANCES, UNMATCHED
from ddco_pyro.metrics import Scores

MATCHINGS = {"matched_globally": "one for all", "matched_per_demonstration": "each its own"}

EXPLAINED = (
    "All measures are at most 1, which is perfect. NMI (normalised mutual information) and ARI (adjusted Rand index, 0 "
    "by chance) compare steps without regard to the options' names. Boundary F1 compares the steps at which segments "
    "begin, within so many steps. The other measures match options with labels so that most steps agree. The match is "
    "the same in all demonstrations (one for all) or separate in each (each its own). Accuracy: share of steps that "
    "agree. IoU: intersection over union, mean over labels. F1@P: a segment is right where it overlaps one of its "
    "label by P % or more. Edit: 1 − edit distance of the sequences of segments. Equal lengths: what cutting each "
    "demonstration into equal parts, as many as options, reaches without looking at it."
)


def measure_names(keys: Iterable[str]) -> list[str]:
    """The names of measures as heads of columns.

    >>> measure_names(["nmi", "boundary_f1_1", "boundary_f1_3", "accuracy", "f1_10", "f1_25"])
    ['NMI', 'boundary F1 ±1', '±3', 'accuracy', 'F1@10', '@25']
    """
    names, before = [], ""
    for key in keys:
        base, _, parameter = key.rpartition("_")
        if base:
            prefix = {"boundary_f1": "boundary F1 ±", "f1": "F1@"}[base]
            names.append((prefix[-1] if base == before else prefix) + parameter)
        else:
            names.append({"nmi": "NMI", "ari": "ARI", "iou": "IoU"}.get(key, key))
        before = base
    return names


def tolerances(frequency: float | None) -> str:
    """A sentence on the seconds of the tolerances of boundary F1; empty where the frequency (Hz) is not known."""
    each = "; ".join(f"±{duration(frequency, steps)}" for steps in TOLERANCES)
    return f"Tolerances of boundary F1: {each}." if frequency else ""


def agreement_table(scores: Mapping[str, Scores | None], title: str | None = None) -> Table:
    """Two rows for each name of segments, one for each way to match options with labels."""
    head = ["Segments", *measure_names(UNMATCHED), "matching", *measure_names(MATCHED)]
    rows = []
    for name, known in scores.items():
        if known is None:
            rows.append([name, *["–"] * (len(head) - 1)])
            continue
        first = [name, *(number(getattr(known, key)) for key in UNMATCHED)]
        for key, matching in MATCHINGS.items():
            rows.append([*first, matching, *(number(value) for _, value in getattr(known, key))])
            first = [""] * len(first)
    return Table(head, rows, {0, 1 + len(UNMATCHED)}, title)
