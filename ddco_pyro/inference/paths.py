"""Whole paths ζ = (b, h) of the latents: the most likely path of a demonstration, and draws from p(ζ | ξ).

A compiled forward pass in log space takes the maximum over predecessors, or their sum; O(D·S) a step. It leaves the
probabilities of each step back, given the choices after it: 0 or 1 for the best path. A path then takes one step back
after the other, without logarithms; O(D + Σ C_d) a step. Four trajectories go side by side on the way forward.
``messages`` and ``spread`` are rows of those of :mod:`ddco_pyro.inference.kernel`, in logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.inference.arguments import refuse_impossible
from ddco_pyro.inference.kernel import BLOCK, Lots, Shape, Structure, lots_of, on_threads, placed, releasing
from ddco_pyro.model.elementary import (
    LANES,
    Array,
    Plane,
    apart,
    at,
    exponential,
    jit,
    lanes,
    logarithm,
    number,
    put,
    record,
    where,
    whole,
    write,
)  # fmt: skip
from ddco_pyro.model.passes import LAST, Lot, Rows, View, take, view_of
from ddco_pyro.model.tables import Tables


class Path(NamedTuple):
    """Choices h and terminations b of every level, lowest first, each int64 [..., N, T]; -1 past the lengths."""

    choices: tuple[Tensor, ...]
    terminations: tuple[Tensor, ...]


class Views(NamedTuple):
    """Log-tables of all levels side by side, float64 [N, T, n]; ``choice`` is the evidence of the joint choices."""

    selection: View
    termination: View
    control: View
    choice: View


class Trace(NamedTuple):
    """What a pass over trajectories reads, and its room.

    ``keeps`` [T, messages] has, for each entry of a level's message, the probability that its last choice was kept at
    t, not selected. ``ways`` [T, messages] has, for the choices of each level below one entry, the distribution
    function of the choice that terminated at t. ``last`` [1, S] is that of the last joint choice.

    :param best: whether the most likely path is wanted instead of draws.
    :param rows: log-tables of a block.
    :param messages: [1, messages]; ``spread`` likewise.
    """

    lots: Lots
    of: Shape
    best: int
    tables: Views
    rows: Rows
    messages: Plane
    spread: Plane
    last: Plane
    keeps: Plane
    ways: Plane


def trace_at(address: int, index: int) -> Any:
    """A trace of those at an address."""


record(trace_at, Trace)


def most_likely_path(tables: Tables, lengths: Tensor) -> Path:
    """argmax over ζ of p(ζ | ξ) (Viterbi), [N, T] for every level.

    Ties are broken from the last step back. The lowest last choice wins, comparing the highest level first. Keeping
    a choice then wins over selecting it anew, and the lowest previous choice over others.

    :param lengths: steps of each trajectory, int64 [N].
    :raises BadTables: a trajectory has probability 0.

    >>> import torch
    >>> selection, ending = torch.tensor([0.0, 0.6, 0.4]).log(), torch.tensor([0.9, 0.1]).log()
    >>> tables = Tables(
    ...     selection=(selection.expand(1, 4, 1, 3),),  # control, option 1, option 2
    ...     termination=(ending.expand(1, 4, 2, 2),),  # 1 - ψ and ψ of both options
    ...     control=(torch.tensor([[[-1.0, -3], [-1, -3], [-9, -1], [-9, -1]]]), torch.full((1, 4, 1), -torch.inf)),
    ... )
    >>> most_likely_path(tables, torch.tensor([4])).choices
    (tensor([[1, 1, 2, 2]]),)
    """
    path = _trace(tables, lengths, best=True, uniforms=np.zeros((1, len(lengths), tables.steps + 1, 2 * tables.depth)))
    return Path(tuple(h[0] for h in path.choices), tuple(b[0] for b in path.terminations))


def sample_paths(tables: Tables, lengths: Tensor, samples: int = 1, seed: int | Sequence[int] = 0) -> Path:
    """Independent draws from p(ζ | ξ), [samples, N, T] for every level.

    :param lengths: steps of each trajectory, int64 [N].
    :param seed: a number from 0 on, or several.
    :raises BadTables: a trajectory has probability 0.

    >>> import torch
    >>> always = torch.tensor([0.0, 0.5, 0.5]).log().expand(1, 3, 1, 3), torch.tensor([0.0, 1.0]).log()
    >>> controls = torch.tensor([[[0.0, -9], [-9, 0], [0, -9]]]), torch.full((1, 3, 1), -torch.inf)
    >>> tables = Tables((always[0],), (always[1].expand(1, 3, 2, 2),), controls)
    >>> sample_paths(tables, torch.tensor([3]), samples=2).choices
    (tensor([[[1, 2, 1]],
    <BLANKLINE>
            [[1, 2, 1]]]),)
    """
    uniforms = np.random.default_rng(seed).random((samples, len(lengths), tables.steps + 1, 2 * tables.depth))
    return _trace(tables, lengths, best=False, uniforms=uniforms)


def segment(tables: Tables, lengths: Tensor) -> tuple[Tensor, ...]:
    """The choices of :func:`most_likely_path`, [N, T] for every level, lowest first; -1 past the lengths.

    >>> from ddco_pyro.model.batch import encode
    >>> batch = encode(demos, fit.hierarchy.encoder, fit.hierarchy.scaling)
    >>> ddco_pyro.inference.segment(fit.hierarchy.tabulate(batch), batch.lengths)[0].shape
    torch.Size([6, 10])

    :param lengths: steps of each trajectory, int64 [N].
    :raises BadTables: a trajectory has probability 0.
    """
    return most_likely_path(tables, lengths).choices


def _trace(tables: Tables, lengths: Tensor, best: bool, uniforms: np.ndarray) -> Path:
    if not tables.depth:
        return Path((), ())
    structure, shape = Structure.of(tables.sizes), Shape.of(tables.sizes)
    joint, terminated = np.full((2, *uniforms.shape[:2], tables.steps), -1, dtype=np.int64)
    possible = np.ones(len(lengths), dtype=np.bool_)
    *levels, meta_policy = tables.control
    evidence = tables.joint_evidence()
    groups = tables.selection, tables.termination, (meta_policy, *levels), () if evidence is None else (evidence,)
    nothing = torch.empty(len(lengths), tables.steps, 0, dtype=torch.float64)
    rows = [torch.cat([nothing, *(table.detach().flatten(2) for table in group)], -1) for group in groups]
    trajectories, each = lots_of(lengths.numpy())
    reading = [trajectories.ctypes.data, each.ctypes.data, *shape, int(best), *chain.from_iterable(map(view_of, rows))]

    def some(first: int, last: int) -> None:
        steps, messages = int(each[first:last, -1].max()), structure.starts[-1]
        block = [(BLOCK, table.shape[2]) for table in rows]
        _room, planes = placed([*block, (1, messages), (1, messages), (1, shape.joint), *[(steps, messages)] * 2])
        numbers = np.append(reading, planes)  # a :class:`Trace`
        _trace_all(first, last, numbers.ctypes.data, uniforms, joint, terminated, possible)

    on_threads(some, each.sum(1))
    refuse_impossible(torch.from_numpy(possible))
    digits = structure.digits(np.arange(len(structure.actors)))
    ended = [np.arange(tables.depth + 1) > level for level in range(tables.depth)]
    return Path(
        tuple(torch.from_numpy(np.append(digit, -1)[joint]) for digit in digits),  # -1, past the end, is the last entry
        tuple(torch.from_numpy(np.append(each.astype(np.int64), -1)[terminated]) for each in ended),
    )


@jit
def _merged(first: Any, second: Any, best: int) -> Any:
    """The larger of two logarithms, or the logarithm of their sum; and the first one's part, 1 or 0 for ``best``."""
    possible, ahead = first > -np.inf, first >= second
    larger, smaller = where(ahead, first, second), where(ahead, second, first)
    if best != 0:
        return larger, where(possible & ahead, 1.0, 0.0)
    less = exponential(where(smaller > -np.inf, smaller - larger, -np.inf))
    total = less + 1.0
    return larger + logarithm(total), where(possible, where(ahead, 1.0, less) / total, 0.0)


@jit
def _cumulative(rows: Plane, t: int, first: int, many: int, best: int) -> Any:
    """Make logarithms a distribution function, and return the logarithm of their sum; of the maximum, for ``best``.

    A number uniform in [0, 1) draws the first entry above it. Zero draws the first of the largest, for ``best``.
    """
    apart()
    total = lanes(-np.inf)
    for i in range(first, first + many):
        total, _ = _merged(total, at(rows, t, i), best)
        put(rows, t, i, total)
    for i in range(first, first + many):
        value = at(rows, t, i)
        put(rows, t, i, where(value == total, 1.0, 0.0) if best != 0 else exponential(value - total))
    return total


@jit
def _up(t: int, i: int, own: Trace) -> None:
    """Fill row t of ``ways``, and ``messages`` of levels 2 to D + 1.

    :param i: the row of the block.
    """
    apart()
    of, messages, ways = own.of, own.messages, own.ways
    for d in range(of.depth):
        c, below = whole(of.sizes, d), whole(of.starts, d)
        for above in range(whole(of.starts, d + 1), whole(of.starts, d + 2)):
            put(ways, t, below, at(messages, 0, below))  # choice 0 lasts one step
            for j in range(1, c):
                ending = at(own.rows.termination, i, whole(of.ends, d) + 2 * j - 1)
                put(ways, t, below + j, at(messages, 0, below + j) + ending)
            put(messages, 0, above, _cumulative(ways, t, below, c, own.best))
            below += c


@jit
def _down(t: int, i: int, own: Trace) -> None:
    """Fill row t of ``keeps``, and ``spread``."""
    apart()
    of, messages, spread, keeps, rows = own.of, own.messages, own.spread, own.keeps, own.rows
    put(spread, 0, whole(of.starts, of.depth), at(messages, 0, whole(of.starts, of.depth)))
    for d in range(of.depth - 1, -1, -1):
        c, below = whole(of.sizes, d), whole(of.starts, d)
        for above in range(whole(of.starts, d + 1), whole(of.starts, d + 2)):
            mass, first = at(spread, 0, above), whole(of.callers, above)
            put(keeps, t, below, 0.0)
            if first < 0:
                put(spread, 0, below, mass)
                for j in range(1, c):
                    put(spread, 0, below + j, -np.inf)
                    put(keeps, t, below + j, 0.0)
            else:
                put(spread, 0, below, mass + at(rows.selection, i, first))
                for j in range(1, c):
                    kept = at(messages, 0, below + j)
                    if t > 0:
                        kept = kept + at(rows.termination, i, whole(of.ends, d) + 2 * j - 2)
                    both, share = _merged(kept, mass + at(rows.selection, i, first + j), own.best)
                    put(spread, 0, below + j, both)
                    put(keeps, t, below + j, share)
            below += c


@jit
def _act(lot: Lot, t: int, i: int, own: Trace) -> None:
    """Fill ``messages`` of level 1 where a trajectory has a step t."""
    of, rows, alive = own.of, own.rows, float(t) < lot.own
    for s in range(of.joint):
        actor, message = whole(of.actors, s), lanes(-np.inf)
        if actor >= 0:
            message = at(own.spread, 0, s) + at(rows.control, i, actor)
            if rows.choice.columns > 0:
                message = message + at(rows.choice, i, s)
        put(own.messages, 0, s, where(alive, message, at(own.messages, 0, s)))


@jit
def _forward(lot: Lot, own: Trace) -> None:
    """Go forward through a block."""
    apart()
    columns = np.intp(1)
    take(own.tables.selection, lot, own.rows.selection.columns, columns, own.rows.selection)
    take(own.tables.termination, lot, own.rows.termination.columns, columns, own.rows.termination)
    take(own.tables.control, lot, own.rows.control.columns, columns, own.rows.control)
    take(own.tables.choice, lot, own.rows.choice.columns, columns, own.rows.choice)
    for t in range(lot.begin, lot.end):
        i = t - lot.begin
        if t > 0:
            _up(t, i, own)
        _down(t, i, own)
        _act(lot, t, i, own)


@jit
def _number(rows: Plane, t: int, column: int, lane: int) -> float:
    return number(rows.address, (t * rows.columns + column) * LANES + lane)  # type: ignore[no-any-return]


@jit
def _pick(rows: Plane, t: int, first: int, many: int, lane: int, uniform: float) -> int:
    """The first entry of a distribution function above ``uniform``."""
    for i in range(many):
        if uniform < _number(rows, t, first + i, lane):
            return i
    return 0  # of a path that has probability 0


@jit
def _back(lane: int, steps: int, own: Trace, uniforms: Array, joint: Array, terminated: Array) -> None:
    """Fill ``joint`` [T] and the number of levels that ``terminated`` [T], from the last step to the first."""
    of = own.of
    index = _pick(own.last, 0, 0, of.joint, lane, uniforms[steps, 0])
    for t in range(steps - 1, -1, -1):
        joint[t] = index
        ended = 0
        while ended < of.depth and not uniforms[t, ended] < _number(own.keeps, t, index, lane):
            index = whole(of.starts, ended + 1) + (index - whole(of.starts, ended)) // whole(of.sizes, ended)
            ended += 1
        terminated[t] = ended
        for d in range(ended - 1 if t > 0 else -1, -1, -1):
            c = whole(of.sizes, d)
            first = whole(of.starts, d) + (index - whole(of.starts, d + 1)) * c
            index = first + _pick(own.ways, t, first, c, lane, uniforms[t, of.depth + d])


@releasing
def _trace_all(
    first: int, last: int, address: int, uniforms: Array, joint: Array, terminated: Array, possible: Array
) -> None:
    """Of lots ``first`` to ``last``, fill the ``joint`` choices [M, N, T] of M paths, and how many levels
    ``terminated`` before each.

    ``possible`` [N] says which trajectories have a probability above 0; the paths of others mean nothing.

    :param address: of a :class:`Trace`.
    :param uniforms: numbers uniform in [0, 1), [M, N, 1 + T, 2·D].
    """
    own = trace_at(address, 0)
    of, messages = own.of, own.messages
    for lot_number in range(first, last):
        who, lengths = own.lots.trajectories + 8 * LANES * lot_number, own.lots.lengths + 8 * LANES * lot_number
        for lane in range(LANES):
            write(own.last.address, lane, float(whole(lengths, lane)))
        until, steps = at(own.last, 0, 0), whole(lengths, LAST)
        for i in range(messages.columns):
            put(messages, 0, i, -np.inf)
        put(messages, 0, whole(of.starts, of.depth), 0.0)  # at t = 0 everything is selected
        for begin in range(0, steps, BLOCK):
            _forward(Lot(who, lengths, begin, min(begin + BLOCK, steps), until), own)
        for s in range(of.joint):
            put(own.last, 0, s, at(messages, 0, s))
        put(messages, 0, 0, _cumulative(own.last, 0, 0, of.joint, own.best))
        for lane in range(LANES):
            n = whole(who, lane)
            if whole(lengths, lane) > 0:
                possible[n] = _number(messages, 0, 0, lane) > -np.inf
                for m in range(len(joint)):
                    _back(lane, whole(lengths, lane), own, uniforms[m, n], joint[m, n], terminated[m, n])
