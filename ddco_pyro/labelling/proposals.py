"""What a model makes of demonstrations, given what a person has said of some steps, and what is expected wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import label_names
from ddco_pyro.data.sources import Source
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.evaluation.inferred import Inferred, runs
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.inference import posterior
from ddco_pyro.labelling.document import FREE, Document
from ddco_pyro.model.recogniser import Windows
from ddco_pyro.model.tables import NEVER
from ddco_pyro.names import choice_names
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments, segments
from ddco_pyro.training.recognition import SHARES, learn

RIDGE = 50.0
"""Of the recogniser of the steps that a person has named."""


def weight(power: float) -> float:
    """γ of the recogniser's evidence beside controls that count β times: 3 β, at most 1.

    It is about the ratio of the pairs that cross-validation tries (:data:`~ddco_pyro.training.recognition.PAIRS`).
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


class Proposals:
    """The exact posterior of a level, with the named steps clamped and a recogniser's evidence of the others.

    The model's options are numbered anew, as a person's: so that the model by itself agrees with the named steps, and
    elsewhere with what was shown before.

    :param level: 1 is the lowest.
    :param count: the options that a person can name.
    :param before: the person's option of each step [T] shown before; empty for the model's own numbers.
    :ivar options: of the person, for each option 0 to k of the model.
    :ivar waiting: the person's options that occur, and that no named step tells of: it has none, and the named ones are
        not those that the model by itself gives to it.
    """

    def __init__(
        self,
        fit: Fit,
        demos: Demonstrations,
        level: int,
        count: int,
        before: Mapping[str, np.ndarray] = MappingProxyType({}),
    ) -> None:
        self.fit, self.level = fit, level
        levels = fit.spec.hierarchy.levels if fit.spec.hierarchy else ()
        self.lasts, self.size = [own.lasts for own in levels], levels[level - 1].count
        self.pieces = list(fit.infer(demos))
        self.options = np.arange(self.size + 1)
        self.place = {name: (piece, row) for piece, own in enumerate(self.pieces) for row, name in enumerate(own.names)}
        with torch.no_grad():
            self.alone = [piece.outputs.tables(piece.batch.actions) for piece in self.pieces]
        model = fit.hierarchy
        self.alone_u = [
            posterior(tables, piece.batch.lengths).u[level - 1]
            for tables, piece in zip(self.alone, self.pieces, strict=True)
        ]
        self.windows = Windows(self.size, model.input_shape, len(model.scaling.varying), past=False)
        every_run = [run for name in demos.names for run in self.runs(name)]
        self.occurring = {option for option, _, _ in every_run} - {0}
        typical = float(np.median([stop - start for _, start, stop in every_run]))
        self.half, self.waiting = typical / 2, np.array([], int)
        self.windows.widths.copy_(torch.tensor([max(1, round(share * typical)) for share in SHARES]))
        self.features = [
            self.windows.features(piece.batch.inputs, piece.batch.actions, piece.batch.lengths) for piece in self.pieces
        ]
        self.usual = np.eye(self.size, count)
        if before:
            self.usual = self._common(before, count)
            self.usual /= self.usual.sum(1, keepdims=True).clip(min=1)
        self.usual *= self.half
        places = zip(demos, (self.place[name] for name in demos.names), strict=True)
        every = torch.cat([self.features[piece][row, : len(demo)] for demo, (piece, row) in places])
        self.middle, self.spread = every.mean(0), every.std(0).clamp(min=1e-9)

    def update(self, labels: Mapping[str, np.ndarray]) -> None:
        """Learn the recogniser of the named steps, clamp these, and infer everything else again.

        The recogniser says nothing of steps that the model by itself gives to an option of :attr:`waiting`: it does not
        know that option, and would speak against it.

        :param labels: an option of the person for each step, [T]; below 1 where the model proposes. An option that the
            model does not have yet clamps nothing.
        """
        self.options = self.aligned(labels)
        allowed = [self._allowed(piece, labels) for piece in self.pieces]
        chosen = [torch.where(own.sum(-1) == 1, own.int().argmax(-1), -1) for own in allowed]
        named = torch.cat([rows[own > 0] for rows, own in zip(self.features, chosen, strict=True)])
        options = torch.cat([own[own > 0] for own in chosen])
        seen = 1 + np.flatnonzero(self._common(labels, max(own.max() for own in labels.values())).sum(1) > self.half)
        unknown = torch.tensor(sorted(self.occurring - {*options.tolist(), *seen.tolist()}))
        self.waiting = self.options[unknown.int().numpy()]
        evident = len(options.unique()) > 1
        if evident:
            learn(self.windows, named, options, RIDGE)
        gamma, again = weight(float(self.fit.hierarchy.power)), []
        every = zip(self.pieces, self.alone, self.alone_u, self.features, allowed, strict=True)
        for piece, tables, u, rows, own in every:
            if evident:
                silent = torch.isin(u.argmax(-1), unknown).unsqueeze(-1)
                ratio = gamma * self.windows.log_ratio(rows)
                tables = tables.with_evidence(self.level, torch.where(silent, 0.0, ratio))
            tables = tables.with_evidence(self.level, torch.where(own, 0.0, NEVER))
            again.append(Inferred(piece.names, piece.batch, piece.hierarchy, tables))
        self.pieces = again

    def held_out(self, labels: Mapping[str, np.ndarray], names: Iterable[str]) -> dict[str, Shown]:
        """What would be shown of each of these demonstrations if nothing were said of it.

        The recogniser is learned without its labels; the model stays, which may have been trained with them.
        :meth:`update` has to follow.
        """
        found = {}
        for name in names:
            self.update({**labels, name: np.full_like(labels[name], FREE)})
            found[name] = self.shown(name)
        return found

    def aligned(self, labels: Mapping[str, np.ndarray]) -> np.ndarray:
        """The person's option for each option 0 to k of the model, another one for each where there are enough.

        An option that is newer than the model is none of them.
        Options keep their numbers unless named steps are against it by more than half a segment of each.
        """
        common = self.usual + self._common(labels, self.usual.shape[1])
        best = common.argmax(1)
        ours, theirs = linear_sum_assignment(-common)
        best[ours] = theirs
        return np.array([0, *(best + 1)])

    def _common(self, labels: Mapping[str, np.ndarray], count: int) -> np.ndarray:
        """The steps that the model by itself expects to have in common with labels 1 to count, [its options, count]."""
        common = np.zeros((max(count, 0), self.size))
        for piece, u in zip(self.pieces, self.alone_u, strict=True):
            for row, name in enumerate(piece.names):
                said = np.flatnonzero((labels[name] > 0) & (labels[name] <= count))
                np.add.at(common, labels[name][said] - 1, u[row, said, 1:].numpy())
        return common.T

    def _allowed(self, piece: Inferred, labels: Mapping[str, np.ndarray]) -> Tensor:
        """The model's choices that a person allows at each step, bool [N, T, 1 + k]."""
        every, ours = torch.full(piece.batch.actions.shape[:2], -1), torch.as_tensor(self.options)
        for row, name in enumerate(piece.names):
            own = labels[name]
            every[row, : len(own)] = torch.as_tensor(np.where(np.isin(own, self.options[1:]), own, -1))
        return (every.unsqueeze(-1) == ours) | (every < 1).unsqueeze(-1)

    def shown(self, name: str, labels: np.ndarray | None = None) -> Shown:
        """The most likely options of a demonstration where its labels say nothing."""
        piece, row = self.place[name]
        own, steps = self.pieces[piece], self.pieces[piece].lengths[row]
        path = own.path.choices[self.level - 1][row, :steps].numpy()
        probability = own.posterior.u[self.level - 1][row, :steps].numpy()[np.arange(steps), path]
        options = self.options[path]
        if labels is not None:
            options = np.where(labels > 0, labels, options)
            probability = np.where(labels > 0, 1.0, probability)
        return Shown(options, np.minimum(probability, 1.0))

    def runs(self, name: str) -> list[tuple[int, int, int]]:
        """The segments of the most likely path: (option of the model, first step, step after the last)."""
        piece, row = self.place[name]
        return runs(*self.pieces[piece].segmented(row, self.lasts)[self.level - 1])

    def drawn(self, name: str) -> dict[int, np.ndarray]:
        """The steps of each boundary of the most likely path in draws from the posterior, by its step in the path."""
        piece, row = self.place[name]
        return self.pieces[piece].drawn(row, self.lasts)[self.level - 1]

    def upper(self, name: str) -> list[tuple[int, list[tuple[int, int, int]]]]:
        """The segments of the other levels, with their numbers, 1 for the lowest."""
        piece, row = self.place[name]
        every = self.pieces[piece].segmented(row, self.lasts)
        return [(n, runs(*own)) for n, own in enumerate(every, start=1) if n != self.level]

    def centre(self, name: str, start: int, stop: int) -> np.ndarray:
        """The mean standardised features of steps of a demonstration."""
        piece, row = self.place[name]
        rows = self.features[piece][row, start:stop]
        centre: np.ndarray = ((rows - self.middle) / self.spread).mean(0).numpy()
        return centre


# --- segments to write ------------------------------------------------------------------------------------------------


def said_segments(document: Document, level: str, source: Source, frequency: float | None) -> Segmented:
    """The labels of a level alone, -1 where nothing is said."""
    each, count = [], len(document.names)
    for name in document.lengths:
        labels = document.in_file(name)
        starts = np.diff(labels, prepend=-9) != 0
        starts[[*document.cuts[name]]] = True
        each.append(Segments(name, {level: LevelLabels(labels, starts, np.ones(len(labels)))}, 0.0, False))
    names: dict[str, Sequence[str]] = {level: choice_names(count, document.names)}
    return Segmented(tuple(each), {level: count}, frequency, {}, names, label_names(source.attributes))


def shown_segments(
    fit: Fit, source: Source, level: str, proposed: Mapping[str, Shown], names: Sequence[str]
) -> Segmented:
    """All levels of a model, one of them as it is shown.

    :param names: of that level's options.
    :raises BadInput: the model lacks an option.
    """
    if len(names) + 1 != len(fit.names[level]):
        raise BadInput("an option is new; refit before you write segments")
    model = segments(fit, source)
    each = []
    for demo in model.segments:
        own = proposed[demo.name]
        labels = LevelLabels(own.options, np.diff(own.options, prepend=-1) != 0, own.probability)
        each.append(replace(demo, levels={**demo.levels, level: labels}))
    return replace(model, segments=tuple(each), names={**model.names, level: choice_names(len(names), names)})


# --- what is expected wrong -------------------------------------------------------------------------------------------

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
