"""Agreement of segments with ground-truth labels, by the measures of the field.

Normalised mutual information (NMI), the adjusted Rand index (ARI) and boundary F1 do not depend on the names
of options. For the other measures options are matched one to one with labels, so that as many steps as
possible agree (Hungarian assignment): *globally*, once for all demonstrations, or *per demonstration*. An
unmatched option, or one that shares no step with its label, agrees with nothing.

Steps labelled :data:`UNKNOWN` are left out. A segment is a maximal run of steps of the same option: selecting
the same option anew is no boundary.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.labels import BOUNDARY, SOURCE, UNKNOWN, label_names
from ddco_pyro.data.sources import open_source
from ddco_pyro.data.tasks import are_several
from ddco_pyro.drawing.page import Table
from ddco_pyro.drawing.words import duration, number
from ddco_pyro.errors import BadInput
from ddco_pyro.metrics import METRICS, Confusion, Matched, Scores
from ddco_pyro.names import label_name
from ddco_pyro.statistics import edit_score, matching

TOLERANCES = (1, 3, 5)
"""Tolerances of boundary F1, in steps."""

OVERLAPS = (10, 25, 50)
"""Thresholds of segmental F1: intersection over union, in percent."""

UNMATCHED = ("nmi", "ari", *(f"boundary_f1_{steps}" for steps in TOLERANCES))
MATCHED = tuple(Matched.model_fields)


def agreement(
    segments: Sequence[np.ndarray], labels: Sequence[np.ndarray], tasks: Sequence[str] = ()
) -> Scores | None:
    """All measures over demonstrations, each at most 1 (perfect); None where no step has a known label.

    Of several tasks, measures are means over tasks: options are matched with the labels of each task alone.

    :data:`EXPLAINED` says what they measure. Boundaries are matched one to one; F1 is 1 where neither side
    has any. A segment is compared with that segment of its label with which it overlaps most, taken once.

    >>> found = agreement([np.array([7, 7, 3, 3])], [np.array([0, 0, 0, 1])])
    >>> found.matched_globally.accuracy, found.boundary_f1_1
    (0.75, 1.0)

    :param segments: options [T] of each demonstration, any integers.
    :param labels: the true ones [T].
    :param tasks: the task of each demonstration; empty for one task.
    """
    if are_several(tasks):
        by_task = (agreement(ours, truth) for ours, truth in _by_task(tasks, segments, labels))
        return _mean([scores for scores in by_task if scores is not None])
    from sklearn.metrics import adjusted_rand_score, normalized_mutual_info_score

    pairs = _known(segments, labels)
    if not pairs:
        return None
    (_, ours), (names, truth) = (_numbered(side) for side in zip(*pairs, strict=True))
    x, y = np.concatenate(ours), np.concatenate(truth)
    match = _matching(_counts(x, y))
    each = [_matching(_counts(h, label)) for h, label in zip(ours, truth, strict=True)]
    everywhere = [match[h] for h in ours]
    by_itself = [own[h] for own, h in zip(each, ours, strict=True)]
    return Scores(
        nmi=float(normalized_mutual_info_score(y, x)),
        ari=float(adjusted_rand_score(y, x)),
        **{f"boundary_f1_{steps}": _boundary_f1(ours, truth, steps) for steps in TOLERANCES},  # type: ignore[arg-type]
        matched_globally=_matched(everywhere, truth, len(names)),
        matched_per_demonstration=_matched(by_itself, truth, len(names)),
    )


def _by_task(tasks: Sequence[str], *sides: Sequence[np.ndarray]) -> Iterator[tuple[list[np.ndarray], ...]]:
    """Of each task, those of the arrays [T] that are of its demonstrations."""
    for task in dict.fromkeys(tasks):
        rows = [row for row, own in enumerate(tasks) if own == task]
        yield tuple([side[row] for row in rows] for side in sides)


def _mean(scores: Sequence[Scores]) -> Scores | None:
    """The mean of each measure; None of none."""
    if not scores:
        return None

    def mean(values: Sequence[Any]) -> Any:
        if isinstance(values[0], dict):
            return {key: mean([value[key] for value in values]) for key in values[0]}
        return float(np.mean(values))

    return Scores.model_validate(mean([one.model_dump() for one in scores]))


EQUAL = "equal lengths"
"""The row of parts of equal length in tables."""


def equal_lengths(steps: int, count: int) -> np.ndarray:
    """The number of the part, from 0 on, of each step [T] of a demonstration that is cut into equal parts."""
    return np.arange(steps) * count // steps


USED = 0.05
"""Share of the steps of a task from which on an option is one of the task."""


def of_equal_lengths(
    labels: Sequence[np.ndarray], count: int, segments: Sequence[np.ndarray] = (), tasks: Sequence[str] = ()
) -> Scores | None:
    """The agreement with labels [T] of demonstrations that are cut into ``count`` equal parts.

    Of several tasks, into as many as options are used in the task (:data:`USED`).

    :param segments: the options [T] of each demonstration; ``tasks`` as in :func:`agreement`.
    """
    if not are_several(tasks):
        return agreement([equal_lengths(len(own), count) for own in labels], labels)
    each = []
    for known, ours in _by_task(tasks, labels, segments):
        shares = np.unique(np.concatenate(ours), return_counts=True)[1] / sum(map(len, ours))
        each.append(of_equal_lengths(known, int((shares >= USED).sum())))
    return _mean([scores for scores in each if scores is not None])


def confusion(segments: Sequence[np.ndarray], labels: Sequence[np.ndarray]) -> Confusion:
    """Steps of each label (rows) in each option (columns), and the label each option matches globally."""
    pairs = _known(segments, labels)
    if not pairs:
        return Confusion(labels=[], options=[], steps=[], matched=[])
    (options, ours), (names, truth) = (_numbered(side) for side in zip(*pairs, strict=True))
    counts = _counts(np.concatenate(ours), np.concatenate(truth))
    matched = [int(names[label]) if label < len(names) else None for label in _matching(counts)]
    columns, rows = np.argsort(options), np.argsort(names)
    return Confusion(
        labels=names[rows].tolist(),
        options=options[columns].tolist(),
        steps=counts[np.ix_(rows, columns)].tolist(),
        matched=[matched[column] for column in columns],
    )


def _known(
    segments: Sequence[np.ndarray], labels: Sequence[np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Options and labels of the steps with a known label, for each demonstration with such steps."""
    pairs = []
    for options, label in zip(segments, labels, strict=True):
        label = np.asarray(label)
        known = label != UNKNOWN
        if known.any():
            pairs.append((np.asarray(options)[known], label[known]))
    return pairs


def _numbered(sequences: Sequence[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """The distinct values, and each sequence as numbers of the values in the order of first appearance.

    The choice between equally good matchings then does not depend on names.
    """
    values, first, numbers = np.unique(np.concatenate(sequences), return_index=True, return_inverse=True)
    order = np.argsort(first)
    places = np.argsort(order)
    return values[order], np.split(places[numbers], np.cumsum([len(one) for one in sequences])[:-1])


def _counts(ours: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Steps of each label in each option, [labels, options]."""
    counts = np.zeros((truth.max() + 1, ours.max() + 1), dtype=int)
    np.add.at(counts, (truth, ours), 1)
    return counts


def _matching(counts: np.ndarray) -> np.ndarray:
    """The label of each option [options]; a distinct number above all labels for an unmatched option."""
    match, options = matching(counts), np.arange(counts.shape[1])
    return np.where((match >= 0) & (counts[match, options] > 0), match, LARGEST + options)


LARGEST = 2**32
"""More labels than there can be."""


def _matched(ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], labels: int) -> Matched:
    x, y = np.concatenate(ours), np.concatenate(truth)
    steps = [((x == label) & (y == label), (x == label) | (y == label)) for label in range(labels)]
    edits = [edit_score(*pair) for pair in zip(ours, truth, strict=True)]
    return Matched(
        accuracy=float((x == y).mean()),
        iou=float(np.mean([both.sum() / either.sum() for both, either in steps])),
        **{f"f1_{percent}": _overlap_f1(ours, truth, percent / 100) for percent in OVERLAPS},
        edit=float(np.mean(edits)),
    )


def _boundaries(sequence: np.ndarray) -> np.ndarray:
    return np.flatnonzero(np.diff(sequence)) + 1


def _boundary_f1(ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], tolerance: int) -> float:
    """F1 = 2 PR / (P + R); 1 where neither side has a boundary."""
    pairs = [(_boundaries(h), _boundaries(label)) for h, label in zip(ours, truth, strict=True)]
    right = sum(len(boundary_distances(a, b, tolerance)) for a, b in pairs)
    every = sum(len(a) + len(b) for a, b in pairs)
    return 2 * right / every if every else 1.0


def boundary_distances(ours: np.ndarray, theirs: np.ndarray, tolerance: int) -> np.ndarray:
    """Distances of sorted steps that are matched one to one within a tolerance: most pairs, and the closest.

    >>> boundary_distances(np.array([10, 12]), np.array([12, 40]), 3).tolist()
    [0]
    """
    from scipy.optimize import linear_sum_assignment

    apart = np.abs(ours[:, None] - theirs)
    cost = np.where(apart <= tolerance, apart, LARGEST)
    distances: np.ndarray = cost[linear_sum_assignment(cost)]
    return distances[distances <= tolerance]


def _overlap_f1(ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], overlap: float) -> float:
    """F1 of segments: right is one that overlaps enough with the one of its label that it overlaps most."""
    right = segments = 0
    for h, label in zip(ours, truth, strict=True):
        starts, begins = (np.concatenate([[0], _boundaries(sequence)]) for sequence in (h, label))
        ends, closes = np.append(starts[1:], len(h)), np.append(begins[1:], len(label))
        taken = np.zeros(len(begins), dtype=bool)
        for start, end in zip(starts, ends, strict=True):
            both = np.minimum(end, closes) - np.maximum(start, begins)
            either = np.maximum(end, closes) - np.minimum(start, begins)
            ratio = np.where(label[begins] == h[start], both / either, 0.0)
            best = int(ratio.argmax())
            taken[best] |= ratio[best] >= overlap
        right += int(taken.sum())
        segments += len(starts) + len(begins)
    return 2 * right / segments


# --- tables -------------------------------------------------------------------------------------------------

MATCHINGS = {"matched_globally": "one for all", "matched_per_demonstration": "each its own"}

EXPLAINED = (
    "All measures are at most 1, which is perfect. NMI (normalised mutual information) and ARI (adjusted "
    "Rand index, 0 by chance) compare steps without regard to the options' names. Boundary F1 compares the "
    "steps at which segments begin, within so many steps. The other measures match options with labels so "
    "that most steps agree. The match is the same in all demonstrations (one for all) or separate in each "
    "(each its own). Accuracy: share of steps that agree. IoU: intersection over union, mean over labels. "
    "F1@P: a segment is right where it overlaps one of its label by P % or more. Edit: 1 − edit distance of "
    "the sequences of segments. Equal lengths: what cutting each demonstration into equal parts, as many as "
    "options, reaches without looking at it. Of several tasks, each measure is the mean over tasks."
)


def tolerances(frequency: float | None) -> str:
    """A sentence on the seconds of boundary F1's tolerances; empty where the frequency (Hz) is unknown."""
    each = "; ".join(f"±{duration(frequency, steps)}" for steps in TOLERANCES)
    return f"Tolerances of boundary F1: {each}." if frequency else ""


def agreement_table(scores: Mapping[str, Scores | None]) -> Table:
    """Two rows for each name of segments, one for each way to match options with labels."""
    unmatched, matched = ([METRICS[key].name for key in keys] for keys in (UNMATCHED, MATCHED))
    head = ["Segments", *unmatched, "matching", *matched]
    rows = []
    for name, known in scores.items():
        if known is None:
            rows.append([name, *["–"] * (len(head) - 1)])
            continue
        first = [name, *(number(getattr(known, key)) for key in UNMATCHED)]
        for key, way in MATCHINGS.items():
            rows.append([*first, way, *(number(value) for _, value in getattr(known, key))])
            first = [""] * len(first)
    return Table(head, rows, {0, 1 + len(UNMATCHED)})


# --- two annotators -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Annotators:
    """How two annotators agree. Boundaries are compared where both say something of the steps on both sides.

    :param demonstrations: which both have.
    :param steps: of these demonstrations; both annotators say ``both`` of them, ``same`` with the same name.
    :param kappa: Cohen's κ over the steps that both said; None without such steps, or with one name alone.
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
        why = f"has none of the demonstrations of {first}; name a file with other labels of them"
        raise BadInput(f"{second}: {why}")
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
    found = {}
    for name, pairs in sorted(labels.items()):
        each = [own.get(name) or known[1 - n].get(name, []) for n, own in enumerate(known)]
        found[name] = compared(name, pairs, each, tolerance)
    return found


def _read(path: str | Path) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, list[str]]]:
    """The labels of each demonstration of a file, and the names of labels 0, 1, ...."""
    with open_source(path) as source:
        labels = {
            demo: {
                name: values
                for name, values in source.read(demo).labels.items()
                if not name.endswith((BOUNDARY, SOURCE)) and values.dtype.kind in "iub"
            }
            for demo in source.names
        }
        return labels, label_names(source.attributes)


def compared(
    name: str, pairs: Sequence[tuple[np.ndarray, np.ndarray]], known: Sequence[Sequence[str]], tolerance: int
) -> Annotators:
    """How two annotators agree on labels of one name.

    :param pairs: the labels of each demonstration by both, [T] each; -1 where one says nothing.
    :param known: the names of labels 0, 1, ... by both.
    :param tolerance: the largest distance of matched boundaries, in steps.
    """
    from sklearn.metrics import cohen_kappa_score

    words = []
    for side, own in zip(zip(*pairs, strict=True), known, strict=True):
        values = np.unique(np.concatenate(side)).tolist()
        words.append({value: label_name(name, value, own) for value in values if value != UNKNOWN})
    names = list(dict.fromkeys([*words[0].values(), *words[1].values()]))
    counts, boundaries, distances = np.zeros((len(names), len(names)), int), [0, 0], list[int]()
    for labels in pairs:
        said = (labels[0] != UNKNOWN) & (labels[1] != UNKNOWN)
        sides = zip(labels, words, strict=True)
        both = [[names.index(of[value]) for value in own[said].tolist()] for own, of in sides]
        np.add.at(counts, tuple(np.array(both, int)), 1)
        inner = said[1:] & said[:-1]
        first, second = (np.flatnonzero((np.diff(own) != 0) & inner) + 1 for own in labels)
        boundaries = [boundaries[0] + len(first), boundaries[1] + len(second)]
        distances += boundary_distances(first, second, tolerance).tolist()
    several = np.count_nonzero(counts.sum(0) + counts.sum(1)) > 1
    rows, columns = np.indices(counts.shape).reshape(2, -1)
    return Annotators(
        demonstrations=len(pairs),
        steps=sum(len(own) for own, _ in pairs),
        both=int(counts.sum()),
        same=int(np.trace(counts)),
        kappa=float(cohen_kappa_score(rows, columns, sample_weight=counts.ravel())) if several else None,
        boundaries=(boundaries[0], boundaries[1]),
        distances=sorted(distances),
        names=names,
        counts=counts.tolist(),
    )
