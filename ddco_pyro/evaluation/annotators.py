"""Two annotators' labels of the same demonstrations, compared by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddco_pyro.data.sources import open_source
from ddco_pyro.data.sources.recording import BOUNDARY, UNKNOWN, label_names
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import boundary_distances
from ddco_pyro.names import label_name


@dataclass(frozen=True)
class Annotators:
    """How two annotators agree. Boundaries are compared where both say something of the steps on both sides.

    :param demonstrations: which both have.
    :param steps: of these demonstrations; ``both`` of them are said by both annotators, ``same`` with the same name.
    :param kappa: Cohen's κ over the steps that both said; None without such steps, or where there is one name alone.
    :param boundaries: the number of each annotator.
    :param distances: of the boundaries that match within the tolerance, in steps, sorted.
    :param names: in the order of their numbers.
    :param counts: steps that the first one calls by a name (row) and the second one by another (column).
    """

    demonstrations: int
    steps: int
    both: int
    same: int
    kappa: float | None
    boundaries: tuple[int, int]
    distances: list[int]
    names: list[str]
    counts: list[list[int]]

    @property
    def boundary_f1(self) -> float:
        """F1 of the matched boundaries; 1 where there is none at all."""
        return 2 * len(self.distances) / sum(self.boundaries) if sum(self.boundaries) else 1.0


def compare_annotators(first: str | Path, second: str | Path, tolerance: int) -> dict[str, Annotators]:
    """What two files say of the same demonstrations, for each name of labels that both have.

    Labels are compared by their names; where one file has names alone, they are the other one's, too.

    :param tolerance: the largest distance of matched boundaries, in steps.
    :raises BadInput: the files share no demonstration or no labels, or a demonstration has different lengths.
    """
    (ours, our_names), (theirs, their_names) = (_read(path) for path in (first, second))
    known = [our_names, their_names]
    shared = [name for name in ours if name in theirs]
    if not shared:
        raise BadInput(f"{second}: has none of the demonstrations of {first}; name a file with other labels of them")
    labels: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for demo in shared:
        a, b = ours[demo], theirs[demo]
        for name in a.keys() & b.keys():
            if len(a[name]) != len(b[name]):
                lengths = f"{len(b[name])} steps, and {len(a[name])} in {first}"
                raise BadInput(f"{second}: {demo} has {lengths}; name files of the same demonstrations")
            labels.setdefault(name, []).append((a[name], b[name]))
    if not labels:
        raise BadInput(f"{second}: has no labels that {first} has, too; labels of the same name are compared")
    return {
        name: _compared(
            name, pairs, [own.get(name) or known[1 - n].get(name, []) for n, own in enumerate(known)], tolerance
        )
        for name, pairs in sorted(labels.items())
    }


def _read(path: str | Path) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, list[str]]]:
    """The labels of each demonstration of a file, and the names of labels 0, 1, ...."""
    with open_source(path) as source:
        columns = {demo: source.recording(demo).labels for demo in source.names}
        labels = {
            demo: {
                name: column.array()
                for name, column in own.items()
                if not name.endswith(BOUNDARY) and column.dtype.kind in "iub"
            }
            for demo, own in columns.items()
        }
        return labels, label_names(source.attributes)


def _compared(
    name: str, pairs: Sequence[tuple[np.ndarray, np.ndarray]], known: Sequence[Sequence[str]], tolerance: int
) -> Annotators:
    from sklearn.metrics import cohen_kappa_score

    values = [np.unique(np.concatenate(side)) for side in zip(*pairs, strict=True)]
    each = [
        {int(own): label_name(name, int(own), known[n]) for own in side if own != UNKNOWN}
        for n, side in enumerate(values)
    ]
    names = list(dict.fromkeys([*each[0].values(), *each[1].values()]))
    counts, boundaries, distances = np.zeros((len(names), len(names)), int), [0, 0], list[int]()
    for labels in pairs:
        said = (labels[0] != UNKNOWN) & (labels[1] != UNKNOWN)
        a, b = (
            np.array([names.index(of[int(value)]) for value in own[said]], int)
            for own, of in zip(labels, each, strict=True)
        )
        np.add.at(counts, (a, b), 1)
        inner = said[1:] & said[:-1]
        starts = [np.flatnonzero((np.diff(own) != 0) & inner) + 1 for own in labels]
        boundaries = [number + len(own) for number, own in zip(boundaries, starts, strict=True)]
        distances += boundary_distances(starts[0], starts[1], tolerance).tolist()
    a, b = (place.repeat(counts.ravel()) for place in np.indices(counts.shape).reshape(2, -1))
    kappa = float(cohen_kappa_score(a, b)) if len(np.union1d(a, b)) > 1 else None
    return Annotators(
        demonstrations=len(pairs),
        steps=sum(len(own) for own, _ in pairs),
        both=int(counts.sum()),
        same=int(np.trace(counts)),
        kappa=kappa,
        boundaries=(boundaries[0], boundaries[1]),
        distances=sorted(distances),
        names=names,
        counts=counts.tolist(),
    )
