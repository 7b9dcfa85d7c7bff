"""How many steps that are shown are expected to be wrong, and which demonstration is worth labelling next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.labelling.document import FREE
from ddco_pyro.labelling.proposals import Shown

USUAL = 0.1
"""ε before anything is accepted: demonstrations that the posterior is sure of count, too."""


def first_wrong(first: Shown, accepted: Shown) -> tuple[float, int]:
    """The steps of a demonstration whose first proposal was expected to be wrong, and those in which it was.

    Other numbers of the same segments are not wrong: a person gives options their numbers.
    """
    found = agreement([first.options], [accepted.options])
    assert found is not None  # there are steps
    return float((1 - first.probability).sum()), round((1 - found.matched_globally.accuracy) * len(first.options))


def excess(proposed: Shown, labels: np.ndarray) -> float:
    """The share of named steps that are wrong in a proposal, less the share that the posterior expects.

    :param labels: an option of each step, [T]; below 1 where none is named.
    """
    said = labels > 0
    return float(((proposed.options != labels) - (1 - proposed.probability))[said].mean()) if said.any() else 0.0


def unforeseen(first: Sequence[float], held_out: Sequence[float]) -> float:
    """ε, the share of steps that are wrong although the posterior is sure of them.

    It is the mean of what was in excess in demonstrations that were held out. The mean of all first proposals counts
    as one more of these: it alone is known of a single demonstration.

    :param first: of each accepted demonstration, :func:`excess` of what was shown before anything was said of it.
    :param held_out: the same of what the model says without its labels.
    """
    if not first:
        return USUAL
    return max(0.0, (float(np.mean(first)) + sum(held_out)) / (1 + len(held_out)))


def expected_wrong(shown: Shown, labels: np.ndarray, sure: float) -> float:
    """The expected number of wrong steps of a demonstration, Σ (1 - p) + ε p over those of which nothing is said.

    :param sure: ε, as :func:`unforeseen` gives it.
    """
    p = shown.probability[labels == FREE]
    return float((1 - p + sure * p).sum())


def ranking(
    wrong: np.ndarray, edits: np.ndarray, centres: np.ndarray, accepted: np.ndarray
) -> tuple[list[int], int | None]:
    """Demonstrations that are not accepted, the one most worth labelling first, then the others; and the least like
    accepted ones, None where there are none.

    Worth is the expected number of wrong steps for an edit, times the mean likeness to those that are not accepted,
    times one minus the likeness to the nearest accepted one. Likeness is exp(-d²/2h²), of the distance d between mean
    features, and h is the median of d.

    :param wrong: the expected number of wrong steps, [N].
    :param edits: the expected number of edits, [N].
    :param centres: mean features, [N, F].
    :param accepted: whether a person is done with each, [N].
    """
    away = np.linalg.norm(centres[:, None] - centres, axis=-1)
    usual = float(np.median(away[np.triu_indices(len(away), 1)])) if len(away) > 1 else 0.0
    like = np.exp(-((away / (usual or 1.0)) ** 2) / 2)
    worth = wrong / edits
    if not accepted.all():
        worth = worth * like[:, ~accepted].mean(1)
    if accepted.any():
        worth = worth * (1 - like[:, accepted].max(1))
    ranked = sorted(range(len(worth)), key=lambda place: (accepted[place], -worth[place]))
    return ranked, int(away[:, accepted].min(1).argmax()) if accepted.any() else None
