"""Inference over demonstrations with a trained model, a piece of bounded size at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, overload

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.arrays import INFERENCE
from ddco_pyro.data.demonstration import check_fitted
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, not_demonstrations
from ddco_pyro.data.tasks import with_task
from ddco_pyro.inference.paths import Path, most_likely_path, sample_paths
from ddco_pyro.inference.posteriors import Posterior, log_predictive, posterior
from ddco_pyro.model.batch import Batch, encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables

GROUP_BYTES = 5e8
"""The most bytes that the demonstrations of a piece, with the results of inference, may take."""

COPIES = 4
"""Bytes for each byte of an observation, with the encoded batch."""


DRAWS = 100
"""Paths of each demonstration that the intervals of its boundaries come from."""


def drawn(
    path: np.ndarray, starts: np.ndarray, options: np.ndarray, chosen: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """Each boundary of a path, and its steps in the draws from p(ζ | ξ) that have it, ascending.

    A boundary is a step at which option a ends and option b begins. A draw has it where it has a step with
    the same a and b between the two neighbouring boundaries of the path; its nearest such step counts.

    >>> path, starts = np.array([1, 1, 2, 2]), np.array([True, False, True, False])
    >>> options = np.array([[1, 1, 2, 2], [1, 2, 2, 2], [1, 1, 1, 1]])
    >>> [(step, at.tolist()) for step, at in drawn(path, starts, options, np.diff(options, prepend=-1) != 0)]
    [(2, [1, 2])]

    :param path: the options of the path [T].
    :param starts: whether a segment of the path begins at a step [T].
    :param options: the options of the draws [M, T].
    :param chosen: whether a draw's segment begins at a step [M, T].
    """
    steps = len(path)
    edges = [0, *(np.flatnonzero(starts[1:]) + 1).tolist(), steps]
    for before, step, after in zip(edges, edges[1:-1], edges[2:], strict=False):
        window = np.arange(before + 1, after)
        ended, begun = options[:, before : after - 1], options[:, before + 1 : after]
        here = (ended == path[step - 1]) & (begun == path[step])
        here &= chosen[:, before + 1 : after]
        distance = np.where(here, np.abs(window - step), steps)
        yield step, np.sort(window[distance.argmin(1)][here.any(1)])


def within(at: np.ndarray, step: int, mass: float = 0.9) -> tuple[int, int]:
    """The first and the last step of the interval of a boundary; both are its step if no draw has it.

    :param at: its steps in draws, ascending.
    :param mass: the share of them that is within the interval, at least; half of the rest is on either side.
    """
    if not len(at):
        return step, step
    tail = int((1 - mass) / 2 * len(at))
    return int(at[tail]), int(at[-1 - tail])


@dataclass(frozen=True, eq=False)
class Inferred:
    """The inference for N demonstrations, padded to the longest, T steps; computed when first read.

    :param names: of the demonstrations.
    :param batch: the demonstrations, encoded for the networks.
    :param given: tables in place of the model's, such as with labels; None for the model's.
    """

    names: tuple[str, ...]
    batch: Batch
    hierarchy: Hierarchy
    given: Tables | None = None

    @property
    def lengths(self) -> tuple[int, ...]:
        """Steps of each demonstration."""
        return tuple(self.batch.lengths.tolist())

    @cached_property
    def outputs(self) -> Outputs:
        """The outputs of the networks at every step."""
        with torch.no_grad():
            return self.hierarchy(self.batch.inputs)

    @cached_property
    def tables(self) -> Tables:
        """The log-probabilities that exact inference works on, with the evidence of a recogniser."""
        if self.given is not None:
            return self.given
        with torch.no_grad():
            return self.hierarchy.recognised(self.outputs.tables(self.batch.actions), self.batch)

    @cached_property
    def log_likelihood(self) -> np.ndarray:
        """Σ_t log p(a_t | s_0..t, a_0..t-1) of each demonstration, nats in the control's own units, [N]."""
        with torch.no_grad():
            alone = self.outputs.tables(self.batch.actions)  # a recogniser has seen the controls that follow
        values: np.ndarray = log_predictive(alone, self.batch.lengths).numpy()
        return values

    @cached_property
    def posterior(self) -> Posterior:
        """u, v and w of §4.1, [N, T, 1 + k] for each level."""
        return posterior(self.tables, self.batch.lengths)

    @cached_property
    def path(self) -> Path:
        """Choices and terminations of the most likely path, [N, T] for each level; -1 past the end."""
        return most_likely_path(self.tables, self.batch.lengths)

    @cached_property
    def recognised(self) -> Tensor | None:
        """The likeliest option of every step by the recogniser alone, [N, T]; None without one."""
        recogniser = self.hierarchy.recogniser
        return None if recogniser is None else recogniser.options(self.batch)

    @property
    def _lasts(self) -> list[bool]:
        return [level.termination is not None for level in self.hierarchy.option_levels()]

    def segmented(self, row: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """The most likely choices of a demonstration, and where segments begin, each [T], for each level."""
        steps = self.lengths[row]
        paths = ((choices[row, :steps].numpy().copy(), ends[row, :steps].numpy())
                 for choices, ends in zip(*self.path, strict=True))  # fmt: skip
        own = zip(paths, self._lasts, strict=True)
        return [(path, started(path, ends, lasts)) for (path, ends), lasts in own]

    def draws(self, row: int, number: int, seed: Sequence[int]) -> np.ndarray:
        """Choices and terminations of draws from p(ζ | ξ) for one demonstration, [2, D, number, T]."""
        length = self.lengths[row]
        tables = self.tables.part(torch.tensor([row]), length)
        path = sample_paths(tables, torch.tensor([length]), number, seed)
        return torch.stack([torch.stack(kind)[:, :, 0] for kind in path]).numpy()

    def drawn(self, row: int) -> list[dict[int, np.ndarray]]:
        """The boundaries of a demonstration, by level: their steps in draws, by the step of the path."""
        found, draws = [], self.draws(row, DRAWS, (0, self.lengths[row]))
        levels = zip(self._lasts, self.segmented(row), *draws, strict=True)
        for lasting, (path, starts), options, ended in levels:
            found.append(dict(drawn(path, starts, options, started(options, ended, lasting))))
        return found

    def intervals(self, row: int) -> list[np.ndarray]:
        """The 90 % interval of the first step of each segment of a demonstration, by level, [segments, 2]."""
        each = ([within(at, step) for step, at in level.items()] for level in self.drawn(row))
        return [np.array([(0, 0), *own]) for own in each]


def started(options: np.ndarray, terminations: np.ndarray, lasts: bool) -> np.ndarray:
    """Whether a segment begins at each step of paths [..., T], true at the first step.

    A segment begins with a new choice, which may be the same option. Where options end after every step
    (``lasts`` is false), a segment begins where the option differs from the step before.
    """
    found: np.ndarray = terminations == 1 if lasts else np.diff(options, prepend=-1) != 0
    found[..., 0] = True
    return found


def runs(options: np.ndarray, starts: np.ndarray) -> list[tuple[int, int, int]]:
    """Each segment of a path as (option, first step, step after the last).

    :param starts: whether a segment begins at a step [T].
    """
    edges = [*np.flatnonzero(starts).tolist(), len(options)]
    return [(int(options[start]), start, stop) for start, stop in pairwise(edges)]


class Segment(NamedTuple):
    """One segment of a demonstration: consecutive steps in which a level keeps its choice.

    A segment ends with a new choice, which may be the same option.

    :ivar option: the choice, 1 to k; 0 where the caller emits the control.
    :ivar start: the first step.
    :ivar steps: how many steps.
    """

    demonstration: str
    level: str
    option: int
    name: str
    start: int
    steps: int


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation(Sequence[np.ndarray]):
    """The most likely choices of a level: for each demonstration an array [T], from 0 (control) to k.

    :param level: its name.
    :param demonstrations: their names.
    :param names: of the choices, control first.
    :param choices: of each demonstration.
    :param starts: whether a segment begins at a step, :func:`started`, bool [T], of each demonstration.
    """

    level: str
    demonstrations: tuple[str, ...]
    names: tuple[str, ...]
    choices: tuple[np.ndarray, ...]
    starts: tuple[np.ndarray, ...]

    def __len__(self) -> int:
        return len(self.choices)

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[np.ndarray, ...]: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | tuple[np.ndarray, ...]:
        return self.choices[index]

    @property
    def segments(self) -> list[Segment]:
        """Every segment in order; ``pandas.DataFrame(segments)`` is a table of them."""
        return [
            Segment(demo, self.level, option, self.names[option], start, stop - start)
            for demo, own, starts in zip(self.demonstrations, self.choices, self.starts, strict=True)
            for option, start, stop in runs(own, starts)
        ]

    def __repr__(self) -> str:
        rows = self.segments
        lines = [f"{self.level}: {len(self)} demonstrations, {len(rows)} segments"]
        for demo in self.demonstrations[:SHOWN]:
            each = (f"{row.name} ({row.steps})" for row in rows if row.demonstration == demo)
            lines.append(f"  {demo}: {', '.join(each)}")
        return "\n".join([*lines, *(["  ..."] if len(self) > SHOWN else [])])


SHOWN = 5
"""Demonstrations that are printed."""


def infer(hierarchy: Hierarchy, demonstrations: Iterable[Demonstration]) -> Iterator[Inferred]:
    """Inference for demonstrations in order, as many together as the networks take at once.

    :param demonstrations: in memory, or an iterable that reads one after the other.
    :raises DemonstrationsError: there are none, a shape is another than in the fit, or a number is too large
        for networks.
    """
    for group in _groups(_read(demonstrations, hierarchy), hierarchy.steps_at_once):
        demos = Demonstrations(tuple(group))
        batch = encode(demos, hierarchy.encoder, hierarchy.scaling, fitted=True)
        yield Inferred(demos.names, batch, hierarchy)


def _read(demonstrations: Iterable[Demonstration], hierarchy: Hierarchy) -> Iterator[Demonstration]:
    """Demonstrations that the model can read.

    :raises DemonstrationsError: one of them is something else.
    """
    if isinstance(demonstrations, str | Mapping) or not isinstance(demonstrations, Iterable):
        raise not_demonstrations(demonstrations)
    for demo in demonstrations:
        if not isinstance(demo, Demonstration):
            raise not_demonstrations(demo)
        demo = with_task(demo, hierarchy.encoder.tasks) if hierarchy.encoder.tasks else demo
        check_fitted(demo, hierarchy.encoder.shapes, hierarchy.scaling.size)
        yield demo


def _groups(demonstrations: Iterable[Demonstration], steps: int) -> Iterator[list[Demonstration]]:
    """Consecutive demonstrations with at most so many steps, padding included, and at least one of them."""
    group: list[Demonstration] = []
    for demo in demonstrations:
        arrays = demo.observations.values()
        observed = sum(array[0].nbytes for array in arrays if isinstance(array, np.ndarray))
        at_most = min(steps, GROUP_BYTES / (COPIES * observed + INFERENCE))
        if group and (len(group) + 1) * max(len(demo), *map(len, group)) > at_most:
            yield group
            group = []
        group.append(demo)
    yield group
