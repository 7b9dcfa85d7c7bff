"""How well the options of different runs agree with labels, on the demonstrations that all of them held out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from ddco_pyro.fitting.fit import Fit

UNMATCHED = ("nmi", "boundary_f1_1", "boundary_f1_3", "boundary_f1_5")


def agreements(fits: Sequence[Fit], order: Sequence[str]) -> list[dict[str, Any]]:
    """For every level of options of the runs, in this ``order``, its measures as ``metrics.json`` has them: ``nmi``,
    ``accuracy`` (mean over frames, options matched with labels globally), and ``boundary_f1_N`` within ±N steps.

    Runs without options or labels are left out; a measure is None where no label is known, or in runs of before.
    """
    by_name = {str(fit): fit for fit in fits}
    return [row for name in order for row in _levels(name, by_name[name])]


def _levels(name: str, fit: Fit) -> Iterator[dict[str, Any]]:
    record = fit.metrics.get("agreement")
    if not record or fit.spec.hierarchy is None:
        return
    for level, labels, scores in zip(fit.spec.hierarchy.levels, record["labels"], record["valid"], strict=True):
        scores = scores or {}
        measures = {key: scores.get(key) for key in UNMATCHED}
        accuracy = scores.get("matched_globally", {}).get("accuracy")
        yield {"run": name, "level": level.name, "labels": labels, **measures, "accuracy": accuracy}
