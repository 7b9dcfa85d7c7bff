"""Forward-backward over the joint choices of a hierarchy in scaled probability space, compiled; O(D·S) a step.

Four trajectories go side by side, each in a lane of :mod:`ddco_pyro.model.elementary`. Their steps go in blocks: passes
fill a block of rows, the forward pass goes on through it, and on the way back each block's posteriors become gradients
before the next block's are computed. :class:`Structure` defines how joint choices and messages are numbered.

Row t of ``messages`` [1 + T, messages, lanes] begins with the filtered probabilities of the joint choices at t - 1.
Above level 1 the row holds the mass that goes up from them at t: the mass that terminated at every level below.
Row t of ``spread`` [T, messages, lanes] holds the mass that comes down again, for levels D + 1 to 2: the terminated
mass, spread by the selections, and the kept mass.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
import torch

from ddco_pyro.model.elementary import (
    LANES,
    Array,
    Outer,
    Plane,
    absolute,
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
from ddco_pyro.model.passes import LAST, Lot, Room, Rows, View, fill, give, slope, take, task

IMPOSSIBLE = -1
"""Marks a joint choice with an option below a choice 0, and a caller that is itself below a choice 0."""

TOLERANCE = 1e-9
"""Allowed error of Σ_s α_t(s) β_t(s) = 1. Rounding changes the sum by less than 1e-12 over 10 000 steps."""

STEPS_A_THREAD = 4096
"""Steps of trajectories that are worth a thread of their own."""

BLOCK = 32
"""Steps of a block: what passes hand each other stays in the first cache."""

SMALL, LARGE = 1e-300, 1e300
"""Mass of a step, and backward messages, beyond which a trajectory is done in log space."""

releasing = numba.njit(  # type: ignore[call-overload]
    cache=True, error_model="numpy", nogil=True, no_cfunc_wrapper=True, no_rewrites=True, pipeline_class=Outer
)
"""Keeps the compiled function on disk, with all that it calls. numba looks at this file alone: delete ``*.nb?`` in
``__pycache__`` after a change to :mod:`ddco_pyro.model.passes` or :mod:`ddco_pyro.model.elementary`."""


class Structure(NamedTuple):
    """Index tables of D levels, lowest first. C_d = 1 + k_d counts a level's choices, control among them.

    A joint choice is one index, with h^D as the slowest digit and h^1 as the fastest. A *message* of level d runs over
    (h^D, ..., h^d). The messages of levels 1 to D + 1 stand one after the other; level D + 1 has a single entry.
    Each row of a table holds the levels side by side.

    :param sizes: C_d, [D].
    :param starts: first index of each level's message, and the number of all entries, [D + 2].
    :param ends: first column of each level in a row of terminations, where a level has [k_d, 2], [D].
    :param callers: for each message entry, its first column in a row of selections as the caller of the level below,
        where a level has [callers, C_d]; :data:`IMPOSSIBLE` for a caller below a choice 0.
    :param actors: for each joint choice, the acting caller's column in a row of controls, [S]. A row has the
        meta-policy, then each level's k_d options; the column is :data:`IMPOSSIBLE` where the joint choice is.
    :param choices: for each joint choice, the columns of its choices in a row of marginals, [S, D].
    """

    sizes: Array
    starts: Array
    ends: Array
    callers: Array
    actors: Array
    choices: Array

    @classmethod
    @cache
    def of(cls, sizes: tuple[int, ...]) -> Structure:
        """The structure of levels with these numbers of choices C_d, lowest first."""
        depth = len(sizes)
        messages = [int(np.prod(sizes[level:])) for level in range(depth + 1)]
        digits = np.indices(sizes[::-1]).reshape(depth, -1)[::-1].T  # [S, D], lowest level first
        callers = [np.full(messages[0], IMPOSSIBLE)]  # level 1 calls no level
        first = 0
        for level, size in enumerate(sizes):
            digit = np.arange(messages[level + 1]) % sizes[level + 1] if level + 1 < depth else np.ones(1, np.int64)
            callers.append(np.where(digit > 0, first + (digit - 1) * size, IMPOSSIBLE))
            first += size * (sizes[level + 1] - 1 if level + 1 < depth else 1)
        controls = _offsets([1, *(size - 1 for size in sizes)])[1:]
        actors = np.zeros(len(digits), np.int64)  # the meta-policy, where every choice is 0
        for level in range(depth - 1, -1, -1):
            chosen = digits[:, level] > 0
            valid = (digits[chosen, level:] > 0).all(1)
            actors[chosen] = np.where(valid, controls[level] + digits[chosen, level] - 1, IMPOSSIBLE)
        return cls(
            sizes=np.array(sizes),
            starts=_offsets(messages),
            ends=_offsets([2 * (size - 1) for size in sizes])[:-1],
            callers=np.concatenate(callers),
            actors=actors,
            choices=np.ascontiguousarray(digits + _offsets(sizes)[:-1]),
        )

    def digits(self, joint: Array) -> tuple[Array, ...]:
        """The choice of each level, lowest first, in joint choices of any shape."""
        choices = []
        for size in self.sizes:
            choices.append(joint % size)
            joint = joint // size
        return tuple(choices)


def _offsets(sizes: Sequence[int]) -> Array:
    """Where each of consecutive parts begins, and where the last one ends."""
    return np.cumsum([0, *sizes])


def on_threads(run: Callable[[int, int], object], lengths: Array) -> None:
    """Call ``run(first, last)`` for parts of the trajectories, or lots of them, on at most ``torch.get_num_threads()``
    threads.

    :param lengths: steps of each, [N].
    """
    number = len(lengths)
    threads = min(torch.get_num_threads(), number, 1 + int(lengths.sum()) // STEPS_A_THREAD)
    if threads == 1:
        run(0, number)
        return
    bounds = [number * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, bounds[:-1], bounds[1:]))


HELD = 4 * 10**6
"""Most numbers of a buffer that is held from one call to the next, so that its pages need not be mapped again."""

_held = threading.local()


def placed(planes: Sequence[tuple[int, int]] | Array) -> tuple[Array, Array]:
    """Room for planes of these rows and columns, one after the other; and the address and columns of each."""
    rows, columns = np.array(planes).T
    ends = np.cumsum(LANES * rows * columns)
    buffer = _buffer(int(ends[-1]))
    return buffer, np.stack([buffer.ctypes.data + 8 * np.append(0, ends[:-1]), columns], 1)


def _buffer(size: int) -> Array:
    if size > HELD:
        return np.empty(size)
    held: Array | None = getattr(_held, "buffer", None)
    if held is None or len(held) < size:
        held = _held.buffer = np.empty(size)
    return held


def lots_of(lengths: Array) -> tuple[Array, Array]:
    """The trajectories of each lot and their lengths, int64 [lots, lanes], the shortest first; 0 is no trajectory.

    :param lengths: steps of each trajectory, [N].
    """
    order = np.argsort(lengths, kind="stable")
    trajectories, each = np.zeros((2, -(-len(lengths) // LANES), LANES), dtype=np.int64)
    trajectories.reshape(-1)[-len(lengths) :], each.reshape(-1)[-len(lengths) :] = order, lengths[order]
    return trajectories, each


class Sizes(NamedTuple):
    """Columns of the planes of a run.

    :param kept: lanes that passes keep of a step; ``shared`` of a trajectory.
    :param room: the most numbers of a step that a pass takes or gives; ``controls`` likewise.
    :param marginals: Σ C_d, or 0 without the posteriors of the choices.
    """

    selection: int
    termination: int
    control: int
    choice: int
    kept: int
    shared: int
    room: int
    controls: int
    messages: int
    marginals: int

    def planes(self, steps: int) -> Array:
        """Rows and columns of the planes of a :class:`Run`, in its order, for trajectories of at most so many steps."""
        rows = self.selection, self.termination, self.control
        room = self.room, self.controls + 1, self.room, self.room, self.room
        block = [(BLOCK, columns) for columns in (*room, *rows, self.marginals)]
        once = [(1, self.messages), (1, self.shared + 2)]
        step = [(steps, columns) for columns in (*rows, self.choice, self.kept, self.messages, 1)]
        return np.array([*block, *once, *step, (1 + steps, self.messages)])


class Shape(NamedTuple):
    """A :class:`Structure` as compiled code reads it: the number of levels D, of joint choices S, and addresses."""

    depth: int
    joint: int
    sizes: int
    starts: int
    ends: int
    callers: int
    actors: int
    choices: int

    @classmethod
    @cache
    def of(cls, sizes: tuple[int, ...]) -> Shape:
        """The shape of a structure, whose arrays stay."""
        structure = Structure.of(sizes)
        return cls(len(structure.sizes), len(structure.actors), *(array.ctypes.data for array in structure))


class Lots(NamedTuple):
    """Addresses of the trajectories of each lot, [lots, lanes], and of their lengths."""

    trajectories: int
    lengths: int


class Tasks(NamedTuple):
    """The number of :class:`ddco_pyro.model.passes.Task`, their address, and that of their constants."""

    number: int
    address: int
    constants: int


class Run(NamedTuple):
    """What a run reads, and its room.

    :param found: address of a row for each trajectory, [N, n + 2]: the gradients of what steps share, then the
        log-likelihood, and whether it is exact.
    :param evidence: of the joint choices, [N, T, S]; ``marginals`` where those of the choices go, [N, T, Σ C_d].
    :param room: of passes, for a block.
    :param sums: the posteriors of a block.
    :param back: [1, messages].
    :param total: a row of ``found``.
    :param rows: of all steps.
    :param kept: what passes keep of each step.
    """

    lots: Lots
    tasks: Tasks
    evidence: View
    marginals: View
    found: int
    of: Shape
    room: Room
    sums: Rows
    back: Plane
    total: Plane
    rows: Rows
    kept: Plane
    spread: Plane
    scale: Plane
    messages: Plane


def run(address: int, index: int) -> Any:
    """A run of those at an address."""


record(run, Run)


# --- forward ----------------------------------------------------------------------------------------------------------


@jit
def _up(t: int, rows: Rows, messages: Plane, of: Shape) -> None:
    """Fill row t of ``messages`` for levels 2 to D + 1."""
    for d in range(of.depth):
        c, below = whole(of.sizes, d), whole(of.starts, d)
        for above in range(whole(of.starts, d + 1), whole(of.starts, d + 2)):
            total = at(messages, t, below)  # choice 0 lasts one step
            for j in range(1, c):
                total = total + at(messages, t, below + j) * at(rows.termination, t, whole(of.ends, d) + 2 * j - 1)
            put(messages, t, above, total)
            below += c


@jit
def _down(t: int, rows: Rows, messages: Plane, spread: Plane, of: Shape) -> None:
    """Fill row t of ``spread`` for levels D + 1 to 2."""
    depth = of.depth
    put(spread, t, whole(of.starts, depth), at(messages, t, whole(of.starts, depth)))
    for d in range(depth - 1, 0, -1):
        c, below = whole(of.sizes, d), whole(of.starts, d)
        for above in range(whole(of.starts, d + 1), whole(of.starts, d + 2)):
            mass, first = at(spread, t, above), whole(of.callers, above)
            if first < 0:
                put(spread, t, below, mass)
                for j in range(1, c):
                    put(spread, t, below + j, 0.0)
            else:
                put(spread, t, below, mass * at(rows.selection, t, first))
                for j in range(1, c):
                    kept = at(messages, t, below + j) * at(rows.termination, t, whole(of.ends, d) + 2 * j - 2)
                    put(spread, t, below + j, mass * at(rows.selection, t, first + j) + kept)
            below += c


@jit
def _act(t: int, rows: Rows, messages: Plane, spread: Plane, of: Shape) -> Any:
    """Fill level 1 of row t + 1 of ``messages``, not yet normalised, and return its sum: the last step of
    :func:`_down`, times the likelihood of the control.
    """
    c, below, total = whole(of.sizes, 0), 0, lanes(0.0)
    weighted = rows.choice.columns > 0
    for above in range(whole(of.starts, 1), whole(of.starts, 2)):
        mass, first = at(spread, t, above), whole(of.callers, above)
        message = mass * at(rows.control, t, whole(of.actors, below))
        if weighted:
            message = message * at(rows.choice, t, below)
        if first < 0:
            for j in range(1, c):
                put(messages, t + 1, below + j, 0.0)
        else:
            message = message * at(rows.selection, t, first)
            for j in range(1, c):
                kept = at(messages, t, below + j) * at(rows.termination, t, 2 * j - 2)
                option = (mass * at(rows.selection, t, first + j) + kept) * at(rows.control, t, j)
                if weighted:
                    option = option * at(rows.choice, t, below + j)
                put(messages, t + 1, below + j, option)
                total = total + option
        put(messages, t + 1, below, message)
        total = total + message
        below += c
    return total


@jit
def _forward(lot: Lot, own: Run) -> Any:
    """Fill a block of ``messages``, ``spread`` and ``scale``; its log-likelihood, NaN where a step leaves no mass."""
    rows, messages, spread, scale, of = own.rows, own.messages, own.spread, own.scale, own.of
    apart()
    value = lanes(0.0)
    for t in range(lot.begin, lot.end):
        if t > 0:
            _up(t, rows, messages, of)
        _down(t, rows, messages, spread, of)
        total = _act(t, rows, messages, spread, of)
        total = where(_alive(lot, t), total, 1.0)
        value = value + where(total < SMALL, np.nan, logarithm(total))
        inverse = 1.0 / total
        put(scale, t, 0, inverse)
        for s in range(of.joint):
            put(messages, t + 1, s, at(messages, t + 1, s) * inverse)
    return value


@jit
def _alive(lot: Lot, t: int) -> Any:
    """The lanes whose trajectory has a step t."""
    return float(t) < lot.own


# --- backward ---------------------------------------------------------------------------------------------------------


@jit
def _add(rows: Plane, t: int, column: int, value: Any) -> None:
    put(rows, t, column, at(rows, t, column) + value)


@jit
def _adjoint_act(
    t: int, i: int, rows: Rows, messages: Plane, spread: Plane, scale: Plane, back: Plane, sums: Rows, of: Shape
) -> Any:
    """Adjoint of :func:`_act` except for the kept mass; returns Σ_s α_t(s) β_t(s).

    ``back`` holds β_t at level 1. It becomes the adjoint of the mass that came down and, at level 2, of ``spread``.

    :param i: the row of ``sums``.
    """
    c, below, total = whole(of.sizes, 0), 0, lanes(0.0)
    weighted = rows.choice.columns > 0
    inverse = at(scale, t, 0)
    for above in range(whole(of.starts, 1), whole(of.starts, 2)):
        actor, first = whole(of.actors, below), whole(of.callers, above)
        both = at(messages, t + 1, below) * at(back, 0, below)
        total = total + both
        _add(sums.control, i, actor, both)
        over = at(back, 0, below) * at(rows.control, t, actor) * inverse
        if weighted:
            over = over * at(rows.choice, t, below)
        if first >= 0:
            mass = at(spread, t, above)
            over = over * at(rows.selection, t, first)
            _add(sums.selection, i, first, mass * over)
            for j in range(1, c):
                both = at(messages, t + 1, below + j) * at(back, 0, below + j)
                total = total + both
                _add(sums.control, i, j, both)
                here = at(back, 0, below + j) * at(rows.control, t, j) * inverse
                if weighted:
                    here = here * at(rows.choice, t, below + j)
                put(back, 0, below + j, here)
                term = here * at(rows.selection, t, first + j)
                over = over + term
                _add(sums.selection, i, first + j, mass * term)
        put(back, 0, above, over)
        below += c
    return total


@jit
def _adjoint_down(t: int, i: int, rows: Rows, spread: Plane, back: Plane, sums: Rows, of: Shape) -> None:
    """Adjoint of the selections in :func:`_down`: ``back`` of levels 3 to D + 1 from level 2's."""
    for d in range(1, of.depth):
        c, below = whole(of.sizes, d), whole(of.starts, d)
        for above in range(whole(of.starts, d + 1), whole(of.starts, d + 2)):
            first = whole(of.callers, above)
            if first < 0:
                put(back, 0, above, at(back, 0, below))
            else:
                mass, total = at(spread, t, above), lanes(0.0)
                for j in range(c):
                    term = at(back, 0, below + j) * at(rows.selection, t, first + j)
                    total = total + term
                    _add(sums.selection, i, first + j, mass * term)
                put(back, 0, above, total)
            below += c


@jit
def _adjoint_up(t: int, i: int, rows: Rows, messages: Plane, back: Plane, sums: Rows, of: Shape) -> None:
    """Adjoint of :func:`_up` and of the kept mass in :func:`_down`: ``back`` becomes that of row t of ``messages``."""
    for d in range(of.depth - 1, -1, -1):
        c, below = whole(of.sizes, d), whole(of.starts, d)
        for above in range(whole(of.starts, d + 1), whole(of.starts, d + 2)):
            over = at(back, 0, above)
            put(back, 0, below, over)
            for j in range(1, c):
                column = whole(of.ends, d) + 2 * (j - 1)
                mass = at(messages, t, below + j)
                keeping = at(back, 0, below + j) * at(rows.termination, t, column)
                stopping = over * at(rows.termination, t, column + 1)
                _add(sums.termination, i, column, mass * keeping)
                _add(sums.termination, i, column + 1, mass * stopping)
                put(back, 0, below + j, keeping + stopping)
            below += c


@jit
def _backward(lot: Lot, own: Run) -> Any:
    """Fill the posteriors of a block; the lanes in which Σ_s α_t(s) β_t(s) = 1 at every step.

    Only underflow can change this sum.
    """
    rows, messages, spread, scale = own.rows, own.messages, own.spread, own.scale
    back, sums, of = own.back, own.sums, own.of
    apart()
    exact = lanes(0.0) == 0.0
    for t in range(lot.end - 1, lot.begin - 1, -1):
        i = t - lot.begin
        if sums.choice.columns:
            for s in range(of.joint):
                if whole(of.actors, s) >= 0:
                    for d in range(of.depth):
                        _add(
                            sums.choice, i, whole(of.choices, s * of.depth + d), at(messages, t + 1, s) * at(back, 0, s)
                        )
        total = _adjoint_act(t, i, rows, messages, spread, scale, back, sums, of)
        exact = exact & (absolute(total - 1.0) <= TOLERANCE)  # NaN is not
        _adjoint_down(t, i, rows, spread, back, sums, of)
        if t > 0:
            _adjoint_up(t, i, rows, messages, back, sums, of)
        if t >= whole(lot.lengths, 0):  # gradients add up over steps
            alive = _alive(lot, t)
            for plane in (sums.selection, sums.termination, sums.control):
                for column in range(plane.columns):
                    put(plane, i, column, where(alive, at(plane, i, column), 0.0))
    for s in range(back.columns):  # an overflow at t = 0 shows nowhere else
        exact = exact & (at(back, 0, s) <= LARGE)
    return exact


# --- whole trajectories -----------------------------------------------------------------------------------------------


@jit
def _fill(lot: Lot, own: Run) -> Any:
    """Fill a block of rows; the sum of the logarithms that densities of controls are scaled by.

    A step past a trajectory's length keeps every choice and emits nothing, so it changes no probability. A step without
    a finite largest density is not scaled.
    """
    tasks, evidence, kept, rows, room, of = own.tasks, own.evidence, own.kept, own.rows, own.room, own.of
    apart()
    choices, columns = rows.choice.columns, rows.control.columns
    for t in range(lot.begin, lot.end):
        for j in range(columns):
            put(rows.control, t, j, 0.0)
    for i in range(tasks.number):
        fill(task(tasks.address, i), lot, tasks.constants, kept, rows, room)
    if evidence.address != 0:
        take(evidence, lot, whole(of.starts, 1), np.intp(1), room.raw)
        for t in range(lot.begin, lot.end):
            for s in range(whole(of.starts, 1)):
                if choices > 0:
                    put(rows.choice, t, s, exponential(at(room.raw, t - lot.begin, s)))
                else:  # a choice of the only level has a column among the controls
                    put(rows.control, t, s, at(rows.control, t, s) + at(room.raw, t - lot.begin, s))
    for t in range(max(lot.begin, whole(lot.lengths, 0)), lot.end):
        _rest(t, lot, rows, of)
    shift = lanes(0.0)
    for t in range(lot.begin, lot.end):
        top = at(rows.control, t, 0)
        for j in range(1, columns):
            x = at(rows.control, t, j)
            top = where(top < x, x, top)
        top = where(absolute(top) < np.inf, top, 0.0)
        shift = shift + top
        for j in range(columns):
            put(rows.control, t, j, exponential(at(rows.control, t, j) - top))
    return shift


@jit
def _rest(t: int, lot: Lot, rows: Rows, of: Shape) -> None:
    """Have the lanes whose trajectory is over keep every choice and emit nothing."""
    apart()
    alive = _alive(lot, t)
    for j in range(rows.selection.columns):
        put(rows.selection, t, j, where(alive, at(rows.selection, t, j), 0.0))
    for above in range(whole(of.starts, 1), whole(of.starts, of.depth + 1)):
        first = whole(of.callers, above)
        if first >= 0:
            put(rows.selection, t, first, where(alive, at(rows.selection, t, first), 1.0))
    for j in range(rows.termination.columns):
        put(rows.termination, t, j, where(alive, at(rows.termination, t, j), 1.0 - j % 2))
    for j in range(rows.control.columns):
        put(rows.control, t, j, where(alive, at(rows.control, t, j), 0.0))
    for s in range(rows.choice.columns):
        put(rows.choice, t, s, where(alive, at(rows.choice, t, s), 1.0))


@jit
def _clear(plane: Plane, steps: int) -> None:
    apart()
    for t in range(steps):
        for j in range(plane.columns):
            put(plane, t, j, 0.0)


@releasing
def eliminate(first: int, last: int, of_run: int) -> None:
    """Of lots ``first`` to ``last``, fill what is found, and write the posteriors and gradients that tasks ask for.

    :param of_run: address of a :class:`Run`.
    """
    own = run(of_run, 0)
    lots, tasks, of = own.lots, own.tasks, own.of
    rows, sums, total, messages = own.rows, own.sums, own.total, own.messages
    shared = total.columns - 2
    for lot_number in range(first, last):
        who, lengths = lots.trajectories + 8 * LANES * lot_number, lots.lengths + 8 * LANES * lot_number
        steps = whole(lengths, LAST)
        for s in range(messages.columns):
            put(messages, 0, s, 0.0)
            put(own.back, 0, s, 1.0)  # level 1: β
        put(messages, 0, whole(of.starts, of.depth), 1.0)  # at t = 0 everything is selected
        for lane in range(LANES):
            write(total.address, lane, float(whole(lengths, lane)))
        until = at(total, 0, 0)
        _clear(total, np.intp(1))
        value, exact = lanes(0.0), lanes(0.0) == 0.0
        for begin in range(0, steps, BLOCK):
            lot = Lot(who, lengths, begin, min(begin + BLOCK, steps), until)
            value = value + _fill(lot, own)
            value = value + _forward(lot, own)
        for begin in range((steps - 1) // BLOCK * BLOCK, -1, -BLOCK):
            lot = Lot(who, lengths, begin, min(begin + BLOCK, steps), until)
            for plane in (sums.selection, sums.termination, sums.control, sums.choice):
                _clear(plane, np.intp(BLOCK))
            exact = exact & _backward(lot, own)
            for i in range(tasks.number):
                slope(task(tasks.address, i), lot, tasks.constants, own.kept, rows, sums, total, own.room)
            if own.marginals.address != 0:
                give(own.marginals, lot, sums.choice.columns, np.intp(1), sums.choice)
        put(total, 0, shared, value)
        put(total, 0, shared + 1, where(exact, 1.0, 0.0))
        for lane in range(LANES):
            if whole(lengths, lane) > 0:
                row = whole(who, lane)
                for column in range(shared + 2):
                    one = number(total.address, column * LANES + lane)
                    write(own.found, row * (shared + 2) + column, one)
