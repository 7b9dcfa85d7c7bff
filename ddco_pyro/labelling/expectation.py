"""How many steps that are shown are expected to be wrong, and which demonstration is worth labelling next."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import numpy as np

from ddco_pyro.labelling.proposals import Shown


def first_wrong(first: Shown, accepted: Shown) -> tuple[float, int]:
    """The steps of a demonstration whose first proposal was expected to be wrong, and those in which it was."""
    return float((1 - first.probability).sum()), int((first.options != accepted.options).sum())


def expected_wrong(shown: Mapping[str, Shown], accepted: Iterable[tuple[float, int]]) -> dict[str, float]:
    """The expected number of wrong steps of each demonstration.

    What posteriors expect is multiplied by the ratio of wrong to expected steps of accepted demonstrations.

    :param accepted: as :func:`first_wrong` gives them.
    """
    expected, wrong = np.sum([(0.0, 0.0), *accepted], axis=0)
    ratio = (wrong + 1) / (expected + 1)
    return {name: float(np.minimum(ratio * (1 - own.probability), 1).sum()) for name, own in shown.items()}


def ranking(
    wrong: Mapping[str, float], centres: Mapping[str, np.ndarray], accepted: Collection[str]
) -> tuple[list[str], str | None]:
    """Demonstrations that are not accepted, the most informative first, then the others; and the least like those.

    :param wrong: of each demonstration, the expected number of wrong steps.
    :param centres: of each demonstration, its mean features.
    """
    known = [centres[name] for name in accepted]
    away = {
        name: min((float(np.linalg.norm(own - one)) for one in known), default=1.0) for name, own in centres.items()
    }
    typical = float(np.median([*away.values()])) or 1.0
    value = {name: wrong[name] * (1 + away[name] / typical) for name in wrong}
    ranked = sorted(wrong, key=lambda name: (name in accepted, -value[name]))
    return ranked, max(away, key=lambda name: away[name]) if known else None
