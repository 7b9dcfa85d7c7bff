"""What a model makes of demonstrations, given what a person has said of some steps, and what may be wrong."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import BOUNDARY, EXCLUDE, SOURCE, SOURCES, UNKNOWN, label_names
from ddco_pyro.data.sources import Source
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.evaluation.inferred import Inferred, runs
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.labelling.document import CONFIRM, FREE, OPEN, PAINT, Change, Document
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.recogniser import Windows
from ddco_pyro.model.tables import NEVER, Tables
from ddco_pyro.names import choice_names, label_name, option_name
from ddco_pyro.segmenting.segments import LevelLabels, Segmented, Segments, segments
from ddco_pyro.statistics import matching
from ddco_pyro.training.recognition import half_widths, learn, typical_length

StepLabels = Mapping[str, np.ndarray]
"""An option of each step, [T], by demonstration; below 1 for none."""

Pictures = Mapping[str, np.ndarray]
"""Features of the pictures of each step, [T, F] by demonstration, which recognisers read; may be empty."""

RIDGE = 50.0
"""Of the recogniser of the steps that a person has named."""

AT_ONCE = 8
"""Demonstrations that are inferred together."""

GONE = -9
"""The person's number of an option of the model that is never proposed."""


def weight(power: float) -> float:
    """γ of the recogniser's evidence beside controls that count β times: 3 β, at most 1.

    It is about the ratio of the pairs that cross-validation tries
    (:data:`~ddco_pyro.training.recognition.PAIRS`).
    """
    return min(1.0, 3 * power)


@dataclass(frozen=True)
class Shown:
    """What is shown of a demonstration.

    :param options: of each step, 1 to k, [T]; 0 where the caller emits the control.
    :param probability: posterior probability of that option, [T]; 1 of a step that a person has named.
    """

    options: np.ndarray
    probability: np.ndarray


def windows_of(
    model: Hierarchy,
    count: int,
    typical: float,
    batches: Iterable[tuple[Sequence[str], Batch]],
    seen: Pictures,
) -> tuple[Windows, list[Tensor]]:
    """A recogniser of so many options that has learned nothing yet; what it reads, [N, T, 3 F] of each batch.

    :param typical: the length of a segment.
    :param batches: with the names of their demonstrations.
    """
    found = list[Tensor]()
    size = next((rows.shape[1] for rows in seen.values()), 0)
    windows = Windows(count, model.input_shape, len(model.scaling.varying), past=False, pictures=size)
    windows.widths.copy_(half_widths(typical))
    for names, batch in batches:
        read = batch.actions
        if seen:
            pictures = pad_sequence([torch.from_numpy(seen[name]) for name in names], batch_first=True)
            read = torch.cat([read, pictures], dim=-1)
        found.append(windows.features(batch.inputs, read, batch.lengths))
    return windows, found


@dataclass(frozen=True)
class Learned:
    """What is learned of the named steps.

    :param windows: a recogniser of a model's options; None where fewer than two have named steps.
    :param unknown: as :meth:`Proposals.unknown` gives them.
    """

    windows: Windows | None
    unknown: Tensor


class Proposals:
    """The exact posterior of a level, with the named steps clamped and a recogniser's evidence of the others.

    The model's options are numbered anew, as a person's: so that the model by itself agrees with the named
    steps, and elsewhere with what was shown before. A path has the model's own numbers, so that a new
    numbering holds at once for all demonstrations, whenever each of them is inferred.

    :param level: 1 is the lowest.
    :param labels: an option of the person for each step, [T], of every demonstration; below 1 where the model
        proposes. An option that the model does not have yet clamps nothing.
    :param count: the options that a person can name.
    :param before: the person's option of each step [T] shown before; empty for the model's own numbers.
    :param seen: empty for none.
    :ivar options: of the person, for each option 0 to k of the model.
    """

    def __init__(
        self,
        fit: Fit,
        demos: Demonstrations,
        level: int,
        labels: StepLabels,
        count: int,
        before: StepLabels = MappingProxyType({}),
        seen: Pictures = MappingProxyType({}),
    ) -> None:
        self.fit, self.level = fit, level
        levels = fit.spec.hierarchy.levels if fit.spec.hierarchy else ()
        self.size = levels[level - 1].count
        self.pieces = list(fit.infer(demos))
        self.place = dict[str, tuple[int, int]]()
        for place, piece in enumerate(self.pieces):
            self.place |= {name: (place, row) for row, name in enumerate(piece.names)}
        with torch.no_grad():
            self.alone = [piece.outputs.tables(piece.batch.actions) for piece in self.pieces]
        pairs = zip(self.pieces, self.alone, strict=True)
        alone = [Inferred(piece.names, piece.batch, piece.hierarchy, tables) for piece, tables in pairs]
        self.alone_u = [piece.posterior.u[level - 1] for piece in alone]
        rows = [piece.segmented(row)[level - 1] for piece in alone for row in range(len(piece.names))]
        every_run = [run for row in rows for run in runs(*row)]
        self.occurring = {option for option, _, _ in every_run} - {0}
        typical = float(np.median([stop - start for _, start, stop in every_run]))
        self.half = typical / 2
        if seen and any((own > 0).any() for own in labels.values()):
            typical = typical_length(labels.values())  # the model knows none where pictures alone show skills
        batches = [(piece.names, piece.batch) for piece in self.pieces]
        self.windows, self.features = windows_of(fit.hierarchy, self.size, typical, batches, seen)
        every = torch.cat([self._rows(name) for name in demos.names])
        self.middle, self.spread = every.mean(0).numpy(), every.std(0).clamp(min=1e-9).numpy()
        self.whole = np.concatenate([self.centres(name, [0]) for name in demos.names])
        self.options = np.array([], int)
        self.renumber(labels, count, before)
        self.learned = self.learn(labels)
        self.paths = dict[str, tuple[np.ndarray, np.ndarray]]()
        for piece in self.infer(demos.names, labels):
            self.paths |= self.found(piece)

    def renumber(self, labels: StepLabels, count: int, before: StepLabels = MappingProxyType({})) -> None:
        """Number the options anew, as the person has other ones; arguments as of the class."""
        self.usual = self._common(before, count) if before else np.eye(self.size, count)
        self.usual *= self.half / self.usual.sum(1, keepdims=True).clip(min=1)
        self.number(labels)

    def number(self, labels: StepLabels) -> bool:
        """Number the options by the named steps: each is another option of the person where there are enough.

        Options keep their numbers unless named steps are against it by more than half a segment of each. An
        option that is newer than the model is none of them. An option of the model that is none of the
        person's is :data:`GONE`, where the person has fewer.

        :return: whether a number changed.
        """
        count = self.usual.shape[1]
        common = self._common(labels, max(count, *(own.max() for own in labels.values())))
        self.told, total = common.sum(1), self.usual + common[:, :count]
        best = total.argmax(1)
        best[total.sum(1) == 0] = GONE - 1
        matched = matching(total.T)
        before, self.options = self.options, np.array([0, *(np.where(matched < 0, best, matched) + 1)])
        return not np.array_equal(before, self.options)

    def _common(self, labels: StepLabels, count: int) -> np.ndarray:
        """The steps that the model by itself expects to share with labels 1 to count [its options, count]."""
        common = np.zeros((count, self.size))
        for name, own in labels.items():
            piece, row = self.place[name]
            said = np.flatnonzero((own > 0) & (own <= count))
            np.add.at(common, own[said] - 1, self.alone_u[piece][row, said, 1:].numpy())
        return common.T

    def unknown(self, labels: StepLabels) -> Tensor:
        """The options of the model that occur, and that no named step tells of.

        Such an option has none, and the named ones are not those that the model by itself gives to it.
        """
        named = {option for own in labels.values() for option in self._by_model(own)[1].tolist()}
        seen = (1 + np.flatnonzero(self.told > self.half)).tolist()
        return torch.tensor(sorted(self.occurring - {*named, *seen}), dtype=torch.int64)

    def waiting(self, labels: StepLabels) -> np.ndarray:
        """The person's options that occur, and that no named step tells of."""
        return self.options[self.unknown(labels).numpy()]

    def _by_model(self, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The named steps of a demonstration whose label stands for one option of the model; that option."""
        counts = np.bincount(self.options[self.options > 0], minlength=labels.max(initial=0) + 1)
        said = np.flatnonzero((labels > 0) & (counts[labels.clip(0)] == 1))
        return said, (self.options[1:] == labels[said, None]).argmax(1) + 1

    def learn(self, labels: StepLabels) -> Learned:
        """Learn the recogniser of the named steps."""
        each = {name: self._by_model(labels[name]) for name in self.place}
        options = torch.as_tensor(np.concatenate([own for _, own in each.values()]))
        windows, unknown = None, self.unknown(labels)
        if len(options.unique()) > 1:
            rows = torch.cat([self._rows(name)[said] for name, (said, _) in each.items()])
            learn(windows := deepcopy(self.windows), rows, options, RIDGE)
        return Learned(windows, unknown)

    def infer(self, names: Iterable[str], labels: StepLabels) -> Iterator[Inferred]:
        """The posterior of some demonstrations, a few at a time: named steps clamped, recogniser as evidence.

        The recogniser says nothing of steps that the model by itself gives to an option unknown to it.
        """
        rows: dict[int, list[int]] = {}
        for name in names:
            place, row = self.place[name]
            rows.setdefault(place, []).append(row)
        gamma, level = weight(float(self.fit.hierarchy.power)), self.level
        for place, own in rows.items():
            for some in torch.tensor(own).split(AT_ONCE):
                piece, alone = self.pieces[place], self.alone[place]
                batch = piece.batch.select(some)
                steps = slice(int(batch.lengths.max()))
                leaves = [None if table is None else table[some, steps] for table in alone.leaves()]
                tables = Tables.of(alone.depth, leaves, alone.power)
                if self.learned.windows is not None:
                    likeliest = self.alone_u[place][some, steps].argmax(-1)
                    silent = torch.isin(likeliest, self.learned.unknown).unsqueeze(-1)
                    ratio = gamma * self.learned.windows.log_ratio(self.features[place][some, steps])
                    tables = tables.with_evidence(level, torch.where(silent, 0.0, ratio))
                chosen = tuple(piece.names[row] for row in some.tolist())
                allowed = self._allowed([labels[name] for name in chosen])
                tables = tables.with_evidence(level, torch.where(allowed, 0.0, NEVER))
                yield Inferred(chosen, batch, piece.hierarchy, tables)

    def found(self, piece: Inferred) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The most likely path of each demonstration, and how probable each of its steps is."""
        u, found = piece.posterior.u[self.level - 1].numpy(), {}
        for row, (name, steps) in enumerate(zip(piece.names, piece.lengths, strict=True)):
            path = piece.path.choices[self.level - 1][row, :steps].numpy()
            found[name] = path, np.minimum(u[row, np.arange(steps), path], 1.0)
        return found

    def held_out(self, labels: StepLabels, names: Iterable[str]) -> dict[str, Shown]:
        """What would be shown of each of these demonstrations if nothing were said of it.

        The recogniser is learned without its labels; the model stays, which may have been trained with them.
        """
        found = {}
        for name in names:
            others, without = copy(self), {**labels, name: np.full_like(labels[name], FREE)}
            others.number(without)
            others.learned = others.learn(without)
            (piece,) = others.infer([name], without)
            others.paths = others.found(piece)
            found[name] = others.shown(name)
        return found

    def _allowed(self, labels: Sequence[np.ndarray]) -> Tensor:
        """The model's choices that a person allows at each step, bool [N, T, 1 + k]."""
        every, ours = torch.full((len(labels), max(map(len, labels))), -1), torch.as_tensor(self.options)
        for row, own in enumerate(labels):
            every[row, : len(own)] = torch.as_tensor(np.where(np.isin(own, self.options[1:]), own, -1))
        return (every.unsqueeze(-1) == ours) | ((every < 1).unsqueeze(-1) & (ours != GONE))

    def shown(self, name: str, labels: np.ndarray | None = None) -> Shown:
        """The most likely options of a demonstration where its labels say nothing."""
        path, probability = self.paths[name]
        options = self.options[path]
        if labels is not None:
            options = np.where(labels > 0, labels, options)
            probability = np.where(labels > 0, 1.0, probability)
        return Shown(options, probability)

    def centres(self, name: str, starts: Sequence[int]) -> np.ndarray:
        """The mean standardised features of each segment of a demonstration, [segments, 3 F].

        :param starts: their first steps.
        """
        rows = self._rows(name).numpy()
        lengths = np.diff(starts, append=len(rows))[:, None]
        centres: np.ndarray = (np.add.reduceat(rows, starts) / lengths - self.middle) / self.spread
        return centres

    def _rows(self, name: str) -> Tensor:
        """The features of each step of a demonstration, [T, 3 F]."""
        piece, row = self.place[name]
        return self.features[piece][row, : self.pieces[piece].lengths[row]]


# --- segments to write --------------------------------------------------------------------------------------


def labels_shown(document: Document, name: str, shown: Shown) -> LevelLabels:
    """What is shown of a demonstration, -1 where a person left it open."""
    left = document.labels[name] == OPEN
    options = np.where(left, UNKNOWN, shown.options)
    starts = np.diff(options, prepend=-9) != 0
    starts[[cut for cut in document.cuts[name] if not left[cut]]] = True
    return LevelLabels(options, starts, np.where(left, 0.0, shown.probability))


def sources_shown(document: Document, name: str) -> np.ndarray:
    """The place in :data:`~ddco_pyro.data.labels.SOURCES` of who says what each step is, [T]."""
    labels = document.labels[name]
    given, accepted, opened, proposed = map(SOURCES.index, ("given", "accepted", "open", "proposed"))
    said = np.where(document.given[name], given, accepted)
    return np.select([labels == OPEN, labels == FREE], [opened, proposed], said)


def said_segments(
    documents: Mapping[str, Document],
    source: Source,
    frequency: float | None,
    marks: Mapping[str, Mapping[str, Any]],
) -> Segmented:
    """The labels of levels alone, -1 where nothing is said.

    :param documents: by level.
    :param marks: of demonstrations.
    """
    each = []
    for name in next(iter(documents.values())).lengths:
        levels, said = dict[str, LevelLabels](), dict[str, np.ndarray]()
        for level, document in documents.items():
            labels = document.in_file(name)
            levels[level] = labels_shown(document, name, Shown(labels, np.ones(len(labels))))
            said[level + SOURCE] = sources_shown(document, name)
        each.append(Segments(name, levels, 0.0, False, sources=said))
    counts = {level: len(document.names) for level, document in documents.items()}
    names = {level: choice_names(counts[level], document.names) for level, document in documents.items()}
    known = {**label_names(source.attributes), **{level + SOURCE: list(SOURCES) for level in documents}}
    return Segmented(tuple(each), counts, frequency, {}, names, known, marks=marks)


def said_in(
    demos: Demonstrations, level: str, names: Sequence[str], lerobot: bool = False, marked: bool = True
) -> list[Change]:
    """What the labels of a file say of a level: those that a page saved, or those of another program.

    Labels that ``segment`` wrote say nothing: a model proposed them.

    :param names: of the options 1 to k, as the run has them. Another name goes to one without, or is new.
    :param lerobot: whether the labels are the subtasks of a LeRobot dataset.
    :param marked: whether marks of demonstrations are read, too.
    """
    level = "subtask" if lerobot else level
    known = label_names(demos.attributes).get(level, ())
    words = label_names(demos.attributes).get(level + SOURCE, SOURCES)
    ours, changes = not lerobot and any(level + SOURCE in demo.labels for demo in demos), list[Change]()
    marks: list[Change] = [("mark", name, EXCLUDE, True) for name in demos.masks.get(EXCLUDE, ()) if marked]
    said = [(demo, {"flag", "note"} & demo.attributes.keys()) for demo in demos if marked]
    marks += [("mark", demo.name, mark, demo.attributes[mark]) for demo, own in said for mark in sorted(own)]
    if not ours and any(level + BOUNDARY in demo.labels for demo in demos):
        return marks
    found, options = [*names], dict[int, int]()
    values = {value for demo in demos for value in np.unique(demo.labels.get(level, UNKNOWN)).tolist()}
    for value in sorted(values - {UNKNOWN} | {*range(ours, len(known))}):
        name = option_name(value, known) if ours else label_name(level, value, known)
        if name not in found:
            unnamed = [n for n, own in enumerate(found) if own == option_name(n + 1)]
            place = value - 1 if value - 1 in unnamed else [*unnamed, len(found)][0]
            found[place : place + 1] = [name]
        options[value] = found.index(name) + 1
    for demo in demos:
        labels = demo.labels.get(level, np.full(len(demo), UNKNOWN))
        given = np.where(labels == UNKNOWN, UNKNOWN, SOURCES.index("given"))
        sources = demo.labels.get(level + SOURCE, given)
        edges = (np.diff(labels, prepend=-9) != 0) | (np.diff(sources, prepend=-9) != 0)
        for value, start, stop in runs(labels, edges):
            source = "proposed" if sources[start] == UNKNOWN else words[sources[start]]
            if source != "proposed":
                kind = CONFIRM if source == "accepted" else PAINT
                changes.append((kind, demo.name, start, stop, OPEN if source == "open" else options[value]))
    return [("names", found), *changes, *marks] if changes else marks


def shown_segments(
    fit: Fit, source: Source, level: str, proposed: Mapping[str, Shown], document: Document
) -> Segmented:
    """All levels of a model, one of them as it is shown.

    :raises BadInput: the model has other options.
    """
    names = document.names
    if len(names) + 1 != len(fit.names[level]):
        raise BadInput("options are new, merged or deleted; refit before you write segments")
    model = segments(fit, source)
    each = []
    for demo in model.segments:
        levels = {**demo.levels, level: labels_shown(document, demo.name, proposed[demo.name])}
        sources = {level + SOURCE: sources_shown(document, demo.name)}
        each.append(replace(demo, levels=levels, sources=sources))
    return replace(
        model,
        segments=tuple(each),
        names={**model.names, level: choice_names(len(names), names)},
        label_names={**model.label_names, level + SOURCE: list(SOURCES)},
    )


# --- what is expected wrong ---------------------------------------------------------------------------------

USUAL = 0.1
"""ε before anything is accepted: demonstrations that the posterior is sure of count, too."""


def first_wrong(first: Shown, accepted: Shown) -> tuple[float, int]:
    """The steps of a demonstration whose first proposal was expected to be wrong, and those in which it was.

    Other numbers of the same segments are not wrong: a person gives options their numbers.
    """
    found = agreement([first.options], [accepted.options])
    assert found is not None  # there are steps
    wrong = round((1 - found.matched_globally.accuracy) * len(first.options))
    return float((1 - first.probability).sum()), wrong


def excess(proposed: Shown, labels: np.ndarray) -> float:
    """The share of named steps that are wrong in a proposal, less the share that the posterior expects.

    :param labels: an option of each step, [T]; below 1 where none is named.
    """
    said = labels > 0
    more = (proposed.options != labels) - (1 - proposed.probability)
    return float(more[said].mean()) if said.any() else 0.0


def unforeseen(first: Sequence[float], held_out: Sequence[float]) -> float:
    """ε, the share of steps that are wrong although the posterior is sure of them.

    It is the mean of what was in excess in demonstrations that were held out. The mean of all first proposals
    counts as one more of these: it alone is known of a single demonstration.

    :param first: of each accepted demonstration, :func:`excess` of what was shown before anything was said.
    :param held_out: the same of what the model says without its labels.
    """
    if not first:
        return USUAL
    return max(0.0, (float(np.mean(first)) + sum(held_out)) / (1 + len(held_out)))


def expected_wrong(shown: Shown, labels: np.ndarray, sure: float) -> float:
    """The expected number of wrong steps of a demonstration, Σ (1 - p) + ε p over those not said.

    :param sure: ε, as :func:`unforeseen` gives it.
    """
    p = shown.probability[labels == FREE]
    return float((1 - p + sure * p).sum())


def ranking(
    wrong: np.ndarray, edits: np.ndarray, centres: np.ndarray, accepted: np.ndarray
) -> tuple[list[int], int | None]:
    """Demonstrations that are not accepted, the one most worth labelling first, then the others; and the
    least like accepted ones, None where there are none.

    Worth is the expected number of wrong steps for an edit, times the mean likeness to those that are not
    accepted, times one minus the likeness to the nearest accepted one. Likeness is exp(-d²/2h²), of the
    distance d between mean features, and h is the median of d.

    :param wrong: the expected number of wrong steps, [N].
    :param edits: the expected number of edits, [N].
    :param centres: mean features, [N, F].
    :param accepted: whether a person is done with each, [N].
    """
    away = cdist(centres, centres)
    usual = float(np.median(away[np.triu_indices(len(away), 1)])) if len(away) > 1 else 0.0
    like = np.exp(-((away / (usual or 1.0)) ** 2) / 2)
    worth = wrong / edits
    if not accepted.all():
        worth = worth * like[:, ~accepted].mean(1)
    if accepted.any():
        worth = worth * (1 - like[:, accepted].max(1))
    ranked = sorted(range(len(worth)), key=lambda place: (accepted[place], -worth[place]))
    return ranked, int(away[:, accepted].min(1).argmax()) if accepted.any() else None
