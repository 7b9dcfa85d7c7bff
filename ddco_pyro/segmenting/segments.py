"""Segments of demonstrations: the most likely option of a run at each step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import INFERENCE, refuse_too_much
from ddco_pyro.data.demonstration import check_fitted, needed
from ddco_pyro.data.demonstrations import Demonstration
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.labels import label_names
from ddco_pyro.data.likeness import Traits, traits
from ddco_pyro.data.sources import Source, open_source
from ddco_pyro.data.tasks import of_tasks, with_task
from ddco_pyro.evaluation.agreement import EQUAL, of_equal_lengths
from ddco_pyro.evaluation.agreement import agreement as scores_of
from ddco_pyro.evaluation.inferred import Inferred, runs
from ddco_pyro.events import Counted, OnEvent, ignore
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import Scores


@dataclass(frozen=True)
class LevelLabels:
    """One level over one demonstration of T steps.

    :param options: choices of the most likely path [T]: 1 to k, or 0 where the caller emits the control; -1
        where a person left the step open.
    :param boundaries: whether the path makes a new choice at this step [T], which may be the same option;
        true at the first step. Where options end after every step: whether the option differs from the step
        before.
    :param probability: posterior probability of the chosen option at each step [T].
    :param intervals: the 90 % interval of each segment's first step [segments, 2], of
        :meth:`~ddco_pyro.evaluation.inferred.Inferred.intervals`; None where unknown.
    """

    options: np.ndarray
    boundaries: np.ndarray
    probability: np.ndarray
    intervals: np.ndarray | None = None

    def runs(self, anew: bool = True) -> list[tuple[int, int, int]]:
        """Each segment as (option, first step, step after the last).

        :param anew: whether a segment ends where the same option is chosen anew.
        """
        return runs(self.options, self.boundaries if anew else np.diff(self.options, prepend=-1))


@dataclass(frozen=True)
class Segments:
    """One demonstration with its segments.

    :param levels: by name, lowest first.
    :param log_likelihood: log p(ξ) per step, nats.
    :param held_out: whether the run's fit held the demonstration out.
    :param labels: ground-truth labels in the file, name to [T].
    :param sources: where a person labelled: ``<level>_source`` to the place in
        :data:`~ddco_pyro.data.labels.SOURCES` [T].
    :param task: the demonstration's own; empty where none is known.
    """

    name: str
    levels: dict[str, LevelLabels]
    log_likelihood: float
    held_out: bool
    labels: dict[str, np.ndarray] = field(default_factory=dict)
    sources: dict[str, np.ndarray] = field(default_factory=dict)
    task: str = ""

    def __len__(self) -> int:
        return len(next(iter(self.levels.values())).options)


@dataclass(frozen=True)
class Segmented:
    """All demonstrations of a source.

    :param counts: the number of options of each level, by name.
    :param frequency: steps per second (Hz); None where unknown.
    :param truth: for each level, the name of the labels that the run's spec compares with it.
    :param names: for each level, the name of each choice, control first.
    :param label_names: for labels in the file, the names of labels 0, 1, ...
    :param matched: for labels that the run's spec compares with a level, the option that each label is
        matched with in the run's own table: of the lowest level, where labels are compared with several.
    :param unlike: a line for each reason why demonstrations are unlike those of the fit.
    :param marks: what a person said of demonstrations as a whole: ``exclude``, ``flag``, ``note``.
    """

    segments: tuple[Segments, ...]
    counts: dict[str, int]
    frequency: float | None
    truth: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    label_names: Mapping[str, Sequence[str]] = field(default_factory=dict)
    matched: Mapping[str, Mapping[int, int]] = field(default_factory=dict)
    unlike: Sequence[str] = ()
    marks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.segments)

    def labelled(self, truth: str) -> dict[str, Sequence[Segments]]:
        """The demonstrations that have these labels, by part in words: held-out ones first, then others."""
        labelled = [demo for demo in self.segments if truth in demo.labels]
        held_out, others = ([demo for demo in labelled if demo.held_out is held] for held in (True, False))
        rest = f"{len(others)} {'others' if held_out else 'in all'}"
        parts = {f"{len(held_out)} held out": held_out, rest: others}
        return {part: group for part, group in parts.items() if group}

    @cached_property
    def agreements(self) -> dict[str, dict[str, Scores | None]]:
        """Agreement of each level that has labels: the measures of each kind of segments, by its name.

        Parts of equal length stand beside the options.
        """
        agreements: dict[str, dict[str, Scores | None]] = {}
        for level, truth in self.truth.items():
            for part, group in self.labelled(truth).items():
                options = [demo.levels[level].options for demo in group]
                labels = [demo.labels[truth] for demo in group]
                scores = agreements.setdefault(level, {})
                tasks = [demo.task for demo in group]
                scores[f"options, {part}"] = scores_of(options, labels, tasks)
                scores[f"{EQUAL}, {part}"] = of_equal_lengths(labels, self.counts[level], options, tasks)
        return agreements


def segment(fit: Fit, path: str | Path) -> Segmented:
    """The options of a run over every demonstration of a file or data set.

    >>> segmented = ddco_pyro.segment(fit, "mine.hdf5")
    >>> len(segmented), segmented.counts, segmented.segments[0].levels["option"].options.shape
    (6, {'option': 2}, (10,))

    :param path: an HDF5 file, or a Minari or LeRobot dataset.
    :raises BadInput: the run has no options, or was fitted to other observations.
    :raises DemonstrationsError: a demonstration cannot be used.
    """
    with open_source(path) as source:
        return segments(fit, source)


def segments(fit: Fit, source: Source, on_event: OnEvent = ignore, intervals: bool = False) -> Segmented:
    """The segments of a source's demonstrations, except those that the run's spec excludes from its file.

    :param intervals: with the intervals of their boundaries.
    :raises BadInput: the run has no options.
    :raises DemonstrationsError: a demonstration cannot be used, or lacks an observation of the run.
    """
    fit.refuse_flat()
    chosen, known = chosen_names(source, fit), label_names(source.attributes)
    labels: dict[str, dict[str, np.ndarray]] = {}
    compared: dict[str, Traits] = {}
    segmented: list[Segments] = []

    def read() -> Iterator[Demonstration]:
        """Each demonstration as the run's networks observe it."""
        before = 0  # steps whose labels are in memory
        for name in chosen:
            found = source.read(name)
            shapes = fit.hierarchy.encoder.shapes
            seen = {key: array for key, array in found.observations.items() if key in shapes}
            inferred = INFERENCE * len(found) + FOUND * fit.hierarchy.depth * (before + len(found))
            whole = needed([Demonstration.stored(name, seen, found.actions)]) + inferred
            refuse_too_much(whole, f"{name}: segmenting its {len(found)} steps", "divide it, or the file")
            flat = {key: values for key, values in found.labels.items() if values.ndim == 1}
            labels[name] = {key: values for key, values in flat.items() if values.dtype.kind in "iub"}
            demo = _demonstration(found, fit)
            compared[name] = traits(demo, demo.observations)
            before += len(demo)
            yield demo

    for piece in fit.infer(read()):
        own = of_piece(fit, piece, labels, intervals)
        segmented += (replace(one, task=compared[one.name].task) for one in own)
        on_event(Counted("segmenting", len(chosen), done=len(segmented)))
    each, known = of_tasks([demo.task for demo in segmented], [demo.labels for demo in segmented], known)
    segmented = [replace(demo, labels=own) for demo, own in zip(segmented, each, strict=True)]
    nats = {demo.name: demo.log_likelihood for demo in segmented}
    unlike = fit.unlike([*compared.values()], nats, source.frequency)
    return replace(of_run(fit, segmented, source.frequency, known), unlike=unlike)


def of_run(
    fit: Fit, segmented: Sequence[Segments], frequency: float | None, known: Mapping[str, Sequence[str]]
) -> Segmented:
    """These segments with what a run says of all: the number and the names of its options, and its labels.

    :param known: for labels in the file, the names of labels 0, 1, ...
    """
    counts = {level.name: level.count for level in fit.spec.levels}
    names = fit.spec.demonstrations.labels_by_level(len(counts))
    truth = dict(zip(counts, names, strict=bool(names)))
    record, matched = fit.metrics.agreement, dict[str, dict[int, int]]()
    for label, table in zip(record.labels, record.confusion, strict=True) if record else ():
        pairs = zip(table.matched, table.options, strict=True)
        matched.setdefault(label, {value: option for value, option in pairs if value is not None})
    return Segmented(tuple(segmented), counts, frequency, truth, fit.names, known, matched)


def recorded(segmented: Segmented, fit: Fit, source: Source) -> Iterator[Demonstration]:
    """The demonstrations of these segments in order, with the observations of the run's networks."""
    return (_demonstration(source.read(demo.name), fit) for demo in segmented.segments)


def chosen_names(source: Source, fit: Fit) -> list[str]:
    """The demonstrations to segment: all except those that the spec excludes from its file."""
    known = fit.spec.demonstrations
    same = known.path is not None and Path(known.path).resolve() == source.path.resolve()
    return [name for name in source.names if not (same and name in known.exclude)]


FOUND = 40
"""Bytes of one step's labels at one level."""


def _demonstration(found: Demonstration, fit: Fit) -> Demonstration:
    """A demonstration of a source with the observations of the run's networks."""
    shapes, tasks = fit.hierarchy.encoder.shapes, fit.hierarchy.encoder.tasks
    found = with_task(found, tasks) if tasks else found
    check_fitted(found, shapes, fit.hierarchy.scaling.size)
    observations = {key: found.observations[key] for key in shapes}
    return Demonstration(found.name, observations, found.actions, attributes=found.attributes)


def of_piece(
    fit: Fit, piece: Inferred, labels: Mapping[str, dict[str, np.ndarray]], intervals: bool
) -> Iterator[Segments]:
    """The segments of each demonstration that was inferred.

    :param labels: ground-truth labels of each demonstration, by its name.
    :raises DemonstrationsError: no options explain a demonstration.
    """
    for row, (name, steps) in enumerate(zip(piece.names, piece.lengths, strict=True)):
        steps_of = np.arange(steps)
        known = piece.intervals(row) if intervals else [None] * len(fit.names)
        every = zip(fit.spec.levels, piece.segmented(row), piece.posterior.u, known, strict=True)
        each = dict[str, LevelLabels]()
        for level, (options, starts), u, within in every:
            probability = np.minimum(u[row].numpy()[steps_of, options], 1.0)  # rounding can exceed 1
            each[level.name] = LevelLabels(options, starts, probability, within)
        value = float(piece.log_likelihood[row])
        if not math.isfinite(value):
            why = f"its log-likelihood is {value}, so no options explain it"
            remedy = "see its controls with ddco-pyro inspect, and repair it or leave it out"
            raise DemonstrationsError(f"{name}: {why}; {remedy}")
        yield Segments(name, each, value / steps, fit.was_held_out(name, value), labels[name])
