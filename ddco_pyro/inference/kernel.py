"""The recursions of the AHMM over a trajectory, compiled; O(D·S) a step for S joint choices.

:func:`eliminate` goes forward over probabilities and back for the gradient, with :data:`LANES` trajectories
side by side. :func:`trace` is the same forward recursion over logarithms of one trajectory, and goes back
along paths.

:class:`Structure` numbers joint choices and messages. Row t of ``messages`` [1 + T, M] begins with the
forward mass of the joint choices at t - 1. Above level 1 the row has the mass that terminated at every level
below, at t. Row t of ``spread`` [T, M] has the mass that comes down again: the selected mass and the kept
mass.

Tables of all levels stand one after the other: selections, terminations, the meta-policy's control, the
options' controls, and factors of the joint choices where there is evidence.

All compiled functions are in this file, so that numba's cache, which looks at the file of an entry point, is
right. Arrays are allocated by callers and indexed in full: numba takes seconds to compile allocations and
slices.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple, cast

import numba
import numpy as np
import torch
from llvmlite import ir
from numba.extending import intrinsic

Array = np.ndarray

IMPOSSIBLE = -1
"""Marks a joint choice with an option below a choice 0, and a caller that is itself below a choice 0."""

TOLERANCE = 1e-9
"""Allowed error of Σ_s α_t(s) β_t(s) = 1. Rounding changes the sum by less than 1e-12 over 10 000 steps."""

ROUNDED = 1e-7
"""Products of masses between it and 1 / it are multiplied on: a logarithm for each step takes longer."""

SMALL, LARGE = 1e-300, 1e300
"""Mass of a step, and backward messages, beyond which a trajectory is done in log space."""

STEPS_A_THREAD = 4096
"""Steps of trajectories that are worth a thread of their own."""

_kept = threading.local()

# The C library keeps free memory up to twice the largest block that it was given back. At first that is so
# little that the system clears the tensors of each step of training anew, which takes a fifth of the step.
torch.empty(2**25 - 2**16, dtype=torch.uint8)


def memory(name: str, *shape: int) -> Array:
    """Room for numbers that this thread keeps: new memory in each pass takes as long as the pass."""
    if len(getattr(_kept, name, ())) < (numbers := math.prod(shape)):
        setattr(_kept, name, new(numbers))
    return cast(Array, getattr(_kept, name)[:numbers].reshape(shape))


def new(*shape: int) -> Array:
    """Room that begins with a line of the cache: no vector lies in two. numpy asks for large pages."""
    room = np.empty((numbers := math.prod(shape)) + LANES)
    return room[-room.ctypes.data // 8 % LANES :][:numbers].reshape(shape)


class Structure(NamedTuple):
    """Index tables of D levels, lowest first. C_d = 1 + k_d counts a level's choices, control among them.

    A joint choice is one index, with h^D as the slowest digit and h^1 as the fastest. A *message* of level d
    runs over (h^D, ..., h^d). The messages of levels 1 to D + 1 stand one after the other, M entries in all;
    level D + 1 has one.

    :param columns: of a row, without the factors of joint choices.
    :param callers: for each message entry above level 1: its first entry below, the number C of entries
        below, its first column in a row as their caller, and the column of their first termination; [M - S,
        4]. A caller below a choice 0 has no column, but :data:`IMPOSSIBLE`.
    :param actors: for each joint choice, the acting caller's column; :data:`IMPOSSIBLE` where the joint
        choice is, [S].
    :param choices: for each joint choice, the columns of its choices in a row of posteriors, which has
        marginals in place of the factors, [S, D].
    :param above: for each message entry below level D + 1, the entry of its caller, [M - 1].
    :param groups: the first column and the number of columns of each choice that is made: each selection and
        each termination, whose probabilities sum to 1, and last of the controls, [G, 2].
    :param inert: the logarithms of a step that keeps every choice, [columns].
    """

    columns: int
    callers: Array
    actors: Array
    choices: Array
    above: Array
    groups: Array
    inert: Array

    @classmethod
    @cache
    def of(cls, sizes: tuple[int, ...]) -> Structure:
        """The structure of levels with these numbers of choices C_d, lowest first."""
        depth = len(sizes)
        messages = [int(np.prod(sizes[level:])) for level in range(depth + 1)]
        calling = [*(size - 1 for size in sizes[1:]), 1]
        selection = _offsets([size * number for size, number in zip(sizes, calling, strict=True)])
        termination = selection[-1] + _offsets([2 * (size - 1) for size in sizes])
        control = termination[-1] + _offsets([1, *(size - 1 for size in sizes)])
        digits = np.indices(sizes[::-1]).reshape(depth, -1)[::-1].T  # [S, D], lowest level first
        actors = np.full(len(digits), control[0])  # the meta-policy, where every choice is 0
        for level in range(depth - 1, -1, -1):
            chosen = digits[:, level] > 0
            valid = (digits[chosen, level:] > 0).all(1)
            actors[chosen] = np.where(valid, control[level + 1] + digits[chosen, level] - 1, IMPOSSIBLE)
        starts, callers, above = _offsets(messages), [], []
        for level, (size, number) in enumerate(zip(sizes, messages[1:], strict=True)):
            each = np.arange(number)
            digit = each % sizes[level + 1] if level + 1 < depth else np.ones(1, np.int64)
            first = np.where(digit > 0, selection[level] + (digit - 1) * size, IMPOSSIBLE)
            ends = np.full(number, termination[level])
            callers.append(np.stack([starts[level] + each * size, np.full(number, size), first, ends], 1))
            above.append(starts[level + 1] + each.repeat(size))
        columns = int(control[-1])
        choices = np.ascontiguousarray(columns + digits + _offsets(sizes)[:-1])
        numbers = [size for size, number in zip(sizes, calling, strict=True) for _ in range(number)]
        numbers += [2] * sum(size - 1 for size in sizes) + [columns - int(termination[-1])]
        groups = np.stack([_offsets(numbers)[:-1], numbers], 1)
        inert = np.full(columns, -np.inf)
        inert[groups[:-1, 0]] = inert[control[0] :] = 0.0
        return cls(columns, np.concatenate(callers), actors, choices, np.concatenate(above), groups, inert)

    @property
    def entries(self) -> int:
        """M."""
        return len(self.above) + 1

    @property
    def tables(self) -> tuple[Array, Array, Array, Array]:
        """The arrays, as compiled functions take them."""
        return self.callers, self.actors, self.choices, self.above


def _offsets(sizes: Sequence[int]) -> Array:
    """Where each of consecutive parts begins, and where the last one ends."""
    return np.cumsum([0, *sizes])


def on_threads(run: Callable[[int, int], object], number: int, steps: int) -> None:
    """Call ``run(first, last)`` for parts of ``number`` units of work, on at most
    ``torch.get_num_threads()`` threads.

    torch itself works on one thread meanwhile: its own threads wait busily, and these would wait for them.

    :param steps: of all units.
    """
    most = torch.get_num_threads()
    threads = min(most, number, 1 + steps // STEPS_A_THREAD)
    if threads == 1:
        run(0, number)
        return
    bounds = [number * part // threads for part in range(threads + 1)]
    torch.set_num_threads(1)
    try:
        list(_pool(threads, os.getpid()).map(run, bounds[:-1], bounds[1:]))
    finally:
        torch.set_num_threads(most)


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads of a process, which keep their memory (:func:`memory`)."""
    return ThreadPoolExecutor(threads)


inner = numba.njit(error_model="numpy", fastmath={"contract"}, inline="always")
# numba's own type knows no unpacking
entry: Callable[[Callable[..., None]], Callable[..., None]] = numba.njit(
    error_model="numpy", fastmath={"contract"}, nogil=True, cache=True
)

# --- trajectories side by side ------------------------------------------------------------------------------

LANES = 8
"""Trajectories side by side: numbers of one vector instruction."""

TOGETHER = 32
"""Steps that are read or written together, column after column: far columns come too late to the cache."""

ONE, ZERO, POWER, TOTAL, TERM, TOP, PRODUCT, FOUND, LEAST, WORST, FIXED = range(11)
"""Rows of a room with a meaning of their own."""


def lanewise(compute: Callable[..., Any]) -> Callable[[Array, int, int, int], None]:
    """A compiled ``f(room, out, a, b)`` over rows of :data:`LANES` numbers of a flat array.

    LLVM does not know that rows are apart, and would make no vector instruction of a loop over them.
    """

    @intrinsic  # type: ignore[untyped-decorator]
    def over_lanes(typing: Any, room: Any, out: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            vector = ir.VectorType(ir.DoubleType(), LANES)
            data = context.make_array(room)(context, builder, arguments[0]).data
            data = builder.bitcast(data, vector.as_pointer())
            into, *of = [builder.gep(data, [row]) for row in arguments[1:]]
            values = [builder.load(place, align=8) for place in (into, *of)]
            builder.store(compute(builder, *values), into, align=8)
            return context.get_dummy_value()

        return numba.void(room, numba.intp, numba.intp, numba.intp), generate

    return cast(Callable[[Array, int, int, int], None], over_lanes)


@intrinsic  # type: ignore[untyped-decorator]
def _moved(typing: Any, into: Any, at: Any, source: Any, start: Any) -> Any:
    """Compiled: copy :data:`LANES` numbers of a flat array to a place of another."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        vector = ir.VectorType(ir.DoubleType(), LANES).as_pointer()

        def place(array: Any, value: Any, index: Any) -> Any:
            data = context.make_array(array)(context, builder, value).data
            return builder.bitcast(builder.gep(data, [index]), vector)

        numbers = builder.load(place(source, *arguments[2:]), align=8)
        builder.store(numbers, place(into, *arguments[:2]), align=8)
        return context.get_dummy_value()

    return numba.void(into, numba.intp, source, numba.intp), generate


move = cast(Callable[[Array, int, Array, int], None], _moved)
FUSED = ("contract",)
multiply = lanewise(lambda make, out, a, b: make.fmul(a, b, FUSED))
accumulate = lanewise(lambda make, out, a, b: make.fadd(out, make.fmul(a, b, FUSED), FUSED))
reduce = lanewise(lambda make, out, a, b: make.fsub(out, make.fmul(a, b, FUSED), FUSED))
add = lanewise(lambda make, out, a, b: make.fadd(a, b, FUSED))
subtract = lanewise(lambda make, out, a, b: make.fsub(a, b, FUSED))
divide = lanewise(lambda make, out, a, b: make.fdiv(a, b))
largest = lanewise(lambda make, out, a, b: make.select(make.fcmp_ordered(">", a, b), a, b))
smallest = lanewise(lambda make, out, a, b: make.select(make.fcmp_ordered("<", a, b), a, b))


@inner
def _exponentials(room: Array, first: int, last: int) -> None:
    """exp of the numbers of some rows, 0 below -708; relative error 2e-16. LLVM vectorises it."""
    values = room[LANES * first : LANES * last]
    for i in range(len(values)):
        x = values[i]
        within = min(max(x, -708.0), 708.0)
        power = math.floor(within * 1.4426950408889634 + 0.5)
        r = within - power * 6.93147180369123816490e-01 - power * 1.90821492927058770002e-10
        q = (
            ((r * (1 / 39916800) + 1 / 3628800) * r + 1 / 362880) * r + 1 / 40320
        ) * r + 1 / 5040  # Taylor's series to r^11
        q = ((((q * r + 1 / 720) * r + 1 / 120) * r + 1 / 24) * r + 1 / 6) * r + 1 / 2
        q = (q * r + 1.0) * r + 1.0
        power_of_two = np.int64((np.int64(power) + 1023) << 52).view(np.float64)
        values[i] = 0.0 if x < -708.0 else q * power_of_two + (x - x)  # NaN stays NaN


@inner
def _lower(room: Array, first: int, number: int) -> None:
    """Subtract from some rows the largest of them, where it is finite; it is in :data:`TOP`."""
    multiply(room, TOP, first, ONE)
    for c in range(first + 1, first + number):
        largest(room, TOP, TOP, c)
    for i in range(LANES * TOP, LANES * TOP + LANES):
        room[i] = room[i] if abs(room[i]) < np.inf else 0.0
    for c in range(first, first + number):
        subtract(room, c, c, TOP)


@inner
def _read(
    room: Array, p: int, stride: int, t: int, first: int, lengths: Array, rows: Array, number: int,
    columns: int, inert: Array,
) -> None:  # fmt: skip
    """Fill the logarithms of some steps of a block from t on. Past its end a trajectory keeps every choice.

    :param p: row of the first of ``number`` logarithms at t; those of the next step are ``stride`` rows on.
    """
    steps = len(rows) // (number * len(lengths))
    for c in range(number):
        for u in range(min(TOGETHER, steps - t)):
            move(room, LANES * (p + u * stride + c), rows, (c * steps + t + u) * len(lengths) + first)
    for lane in range(LANES):
        for u in range(max(lengths[first + lane] - t, 0), min(TOGETHER, steps - t)):
            for c in range(number):
                room[LANES * (p + u * stride + c) + lane] = inert[c] if c < columns else 0.0


@inner
def _load(room: Array, p: int, number: int, columns: int, logits: bool, powered: bool, groups: Array) -> None:
    """From logarithms at a step to probabilities."""
    controls = groups[-1, 0]
    for c in range(p + controls, p + columns if powered else 0):
        multiply(room, c, c, POWER)
    for g in range(0 if logits else len(groups) - 1, len(groups)):
        _lower(room, p + groups[g, 0], groups[g, 1])
    add(room, FOUND, FOUND, TOP)
    if number > columns:
        _lower(room, p + columns, number - columns)
        add(room, FOUND, FOUND, TOP)
    _exponentials(room, p, p + number)
    for g in range(len(groups) - 1 if logits else 0):
        first, last = p + groups[g, 0], p + groups[g, 0] + groups[g, 1]
        add(room, TOTAL, first, first + 1)
        for c in range(first + 2, last):
            add(room, TOTAL, TOTAL, c)
        divide(room, TERM, ONE, TOTAL)
        for c in range(first, last):
            multiply(room, c, c, TERM)


@inner
def _forward(room: Array, p: int, number: int, columns: int, t: int, callers: Array, actors: Array) -> None:
    """Fill the rest of step t and level 1 of the messages after it; their sum before they are scaled is
    :data:`TOTAL`.

    :param p: row of the first of ``number`` probabilities at t. The messages, the spread mass, and one row
        for the scale follow.
    """
    choices, last = len(actors), len(callers) - 1
    m, spread = p + number, p + number + choices + len(callers)
    after, scale = spread + choices + len(callers) + 1 + number, spread + choices + len(callers)
    for i in range(len(callers) if t > 0 else 0):
        above, below, ends = m + choices + i, m + callers[i, 0], p + callers[i, 3]
        multiply(room, above, below, ONE)  # choice 0 lasts one step
        for j in range(1, callers[i, 1]):
            accumulate(room, above, below + j, ends + 2 * j - 1)
    multiply(room, spread + choices + last, m + choices + last, ONE)
    for i in range(last, -1, -1):
        below, calls, mass = callers[i, 0], callers[i, 2], spread + choices + i
        multiply(room, spread + below, mass, ONE if calls < 0 else p + calls)
        for j in range(1, callers[i, 1]):
            arrived = spread + below + j
            multiply(room, arrived, mass, ZERO if calls < 0 else p + calls + j)
            if t > 0 and calls >= 0:
                accumulate(room, arrived, m + below + j, p + callers[i, 3] + 2 * j - 2)
    multiply(room, TOTAL, ZERO, ZERO)
    for s in range(choices):
        multiply(room, after + s, spread + s, ZERO if actors[s] < 0 else p + actors[s])
        if number > columns:
            multiply(room, after + s, after + s, p + columns + s)
        add(room, TOTAL, TOTAL, after + s)
    divide(room, scale, ONE, TOTAL)
    for s in range(choices):
        multiply(room, after + s, after + s, scale)


@inner
def _backward(
    room: Array, p: int, number: int, columns: int, t: int, gain: int, gains: int, callers: Array,
    actors: Array, choices: Array,
) -> None:  # fmt: skip
    """Adjoint of :func:`_forward`: the rows from :data:`FIXED` on go from β_t to β of t - 1. Fill ``gain``
    with the posteriors.

    :data:`TOTAL` is Σ_s α_t(s) β_t(s).
    """
    size = len(actors) + len(callers)
    m, spread, back = p + number, p + number + size, FIXED
    scale, after = spread + size, spread + size + 1 + number
    for c in range(gains):
        multiply(room, gain + c, ZERO, ZERO)
    multiply(room, TOTAL, ZERO, ZERO)
    for s in range(len(actors)):
        if actors[s] < 0:
            multiply(room, back + s, ZERO, ZERO)
            continue
        multiply(room, TERM, after + s, back + s)
        add(room, TOTAL, TOTAL, TERM)
        add(room, gain + actors[s], gain + actors[s], TERM)
        for d in range(choices.shape[1] if gains > columns else 0):
            add(room, gain + choices[s, d], gain + choices[s, d], TERM)
        multiply(room, back + s, back + s, scale)
        multiply(room, back + s, back + s, p + actors[s])
        if number > columns:
            multiply(room, back + s, back + s, p + columns + s)
    for i in range(len(callers)):
        below, calls, over = back + callers[i, 0], callers[i, 2], back + len(actors) + i
        multiply(room, over, below, ONE if calls < 0 else ZERO)
        for j in range(callers[i, 1] if calls >= 0 else 0):
            multiply(room, TERM, below + j, p + calls + j)
            add(room, over, over, TERM)
            accumulate(room, gain + calls + j, spread + len(actors) + i, TERM)
    for i in range(len(callers) - 1 if t > 0 else -1, -1, -1):
        below, ends, over = callers[i, 0], callers[i, 3], back + len(actors) + i
        multiply(room, back + below, over, ONE)
        for j in range(1, callers[i, 1]):
            kept, mass = back + below + j, m + below + j
            multiply(room, kept, kept, p + ends + 2 * j - 2)
            multiply(room, TERM, over, p + ends + 2 * j - 1)
            accumulate(room, gain + ends + 2 * j - 2, mass, kept)
            accumulate(room, gain + ends + 2 * j - 1, mass, TERM)
            add(room, kept, kept, TERM)


@entry
def eliminate(
    lengths: Array, rows: Array, posterior: Array, width: int, value: Array, exact: Array, room: Array,
    power: float, logits: bool, gradient: bool, number: int, gains: int, columns: int, callers: Array,
    actors: Array, choices: Array, above: Array, groups: Array, inert: Array,
) -> None:  # fmt: skip
    """Fill ``value``, ``exact`` and the posteriors, with :data:`LANES` trajectories in a block.

    Each step is scaled to a mass of 1. Underflow there matters only where the past makes next to impossible
    what the future demands. Then Σ_s α_t(s) β_t(s) is not 1, and the trajectory is not ``exact``.

    :param lengths: of the trajectories, [N], N a multiple of :data:`LANES`; 0 where there is none. Those of a
        block should be about as long.
    :param rows: ``number`` columns of log-probabilities, a flat [number, T, N]; of selections and
        terminations logits where ``logits`` says so.
    :param posterior: these trajectories' place in a flat [gains, T, ``width``], or that of the derivative of
        log p(ξ) with respect to ``rows``, where ``gradient`` says so.
    :param value: log p(ξ), [N]; ``exact`` likewise.
    :param room: of :func:`room_for`.
    """
    size, steps = len(above) + 1, len(rows) // (number * len(lengths))
    begin, stride, controls = FIXED + size, number + 2 * size + 1, groups[-1, 0]
    for i in range(LANES):
        room[LANES * ONE + i], room[LANES * ZERO + i], room[LANES * POWER + i] = 1.0, 0.0, power
    for first in range(0, len(lengths), LANES):
        longest = 0
        for lane in range(LANES):
            longest = max(longest, lengths[first + lane])
        multiply(room, FOUND, ZERO, ZERO)
        multiply(room, WORST, ZERO, ZERO)
        multiply(room, PRODUCT, ONE, ONE)
        multiply(room, LEAST, ONE, ONE)
        for i in range(size):  # at t = 0 everything is selected
            multiply(room, begin + number + i, ZERO if i < size - 1 else ONE, ONE)
        for t in range(longest):
            p = begin + t * stride
            if t % TOGETHER == 0:
                _read(room, p, stride, t, first, lengths, rows, number, columns, inert)
            _load(room, p, number, columns, logits, power != 1.0, groups)
            _forward(room, p, number, columns, t, callers, actors)
            smallest(room, LEAST, LEAST, TOTAL)
            multiply(room, PRODUCT, PRODUCT, TOTAL)
            for lane in range(LANES):
                product = room[LANES * PRODUCT + lane]
                if not ROUNDED < product < 1.0 / ROUNDED:  # logarithms are slow
                    room[LANES * FOUND + lane] += math.log(product)
                    room[LANES * PRODUCT + lane] = 1.0
        for i in range(size):
            multiply(room, FIXED + i, ONE, ONE)
        for t in range(longest - 1, -1, -1):
            p, gain = begin + t * stride, begin + (t + 2) * stride
            _backward(room, p, number, columns, t, gain, gains, callers, actors, choices)
            subtract(room, TERM, TOTAL, ONE)
            accumulate(room, WORST, TERM, TERM)
            for g in range(len(groups) - 1 if gradient and logits else 0):
                multiply(room, TOTAL, ZERO, ZERO)
                for c in range(groups[g, 0], groups[g, 0] + groups[g, 1]):
                    add(room, TOTAL, TOTAL, gain + c)
                for c in range(groups[g, 0], groups[g, 0] + groups[g, 1]):
                    reduce(room, gain + c, TOTAL, p + c)
            for c in range(controls, columns if gradient else 0):
                multiply(room, gain + c, gain + c, POWER)
            for lane in range(LANES):
                for c in range(gains if t >= lengths[first + lane] else 0):
                    room[LANES * (gain + c) + lane] = 0.0
            if t % TOGETHER == 0:
                for c in range(gains):
                    for u in range(min(TOGETHER, longest - t)):
                        place = (c * steps + t + u) * width + first
                        move(posterior, place, room, LANES * (gain + u * stride + c))
        for t in range(longest, steps):
            for c in range(gains):
                move(posterior, (c * steps + t) * width + first, room, LANES * ZERO)
        for lane in range(LANES):
            n, most = first + lane, 0.0
            for i in range(size):  # an overflow at t = 0 shows nowhere else
                reached = room[LANES * (FIXED + i) + lane]
                most = reached if not reached <= most else most  # NaN is not
            value[n] = room[LANES * FOUND + lane] + math.log(room[LANES * PRODUCT + lane])
            within = (
                room[LANES * LEAST + lane] >= SMALL and room[LANES * WORST + lane] <= TOLERANCE * TOLERANCE
            )
            exact[n] = within and most <= LARGE and abs(value[n]) < np.inf


def room_for(steps: int, columns: int, entries: int) -> Array:
    """Room for :func:`eliminate`: rows of T steps, M messages. Posteriors replace the next step but one."""
    return memory("room", LANES * (FIXED + entries + (steps + 2) * (columns + 2 * entries + 1)))


# --- trajectories alone, in logarithms ----------------------------------------------------------------------

LOG_SUM, LARGEST = range(2)
"""Semirings: sums of probabilities, and maxima, both of their logarithms."""


@inner
def _plus(semiring: int, first: float, second: float) -> float:
    larger, smaller = (first, second) if first >= second else (second, first)
    if semiring == LARGEST or smaller == -np.inf:
        return larger
    return larger + math.log(1.0 + math.exp(smaller - larger))


@inner
def _predict(
    semiring: int, t: int, n: int, rows: Array, messages: Array, spread: Array, callers: Array, actors: Array
) -> None:
    """Fill ``messages[t]`` above level 1 and ``spread[t]``: the mass of joint choices before the control."""
    last = len(callers) - 1
    if t > 0:
        for i in range(len(callers)):
            below, ends = callers[i, 0], callers[i, 3]
            total = messages[t, below]  # choice 0 lasts one step
            for j in range(1, callers[i, 1]):
                total = _plus(semiring, total, messages[t, below + j] + rows[n, t, ends + 2 * j - 1])
            messages[t, len(actors) + i] = total
    spread[t, len(actors) + last] = messages[t, len(actors) + last]
    for i in range(last, -1, -1):
        below, calls, ends, mass = callers[i, 0], callers[i, 2], callers[i, 3], spread[t, len(actors) + i]
        spread[t, below] = mass if calls < 0 else mass + rows[n, t, calls]
        for j in range(1, callers[i, 1]):
            arrived = -np.inf
            if calls >= 0:
                arrived = mass + rows[n, t, calls + j]
                if t > 0:
                    arrived = _plus(semiring, arrived, messages[t, below + j] + rows[n, t, ends + 2 * j - 2])
            spread[t, below + j] = arrived


@inner
def _act(
    semiring: int, t: int, n: int, rows: Array, columns: int, messages: Array, spread: Array, actors: Array
) -> float:
    """Fill level 1 of ``messages[t + 1]``: the mass of each joint choice and the control at t. Its sum."""
    total, weighted = -np.inf, rows.shape[2] > columns
    for s in range(len(actors)):
        mass = -np.inf
        if actors[s] >= 0:
            mass = spread[t, s] + rows[n, t, actors[s]]
            if weighted:
                mass += rows[n, t, columns + s]
            total = _plus(semiring, total, mass)
        messages[t + 1, s] = mass
    return total


@inner
def _share(semiring: int, part: float, whole: float) -> float:
    """The probability of a part of the mass, from logarithms; of the maximum, 1 where the part is it."""
    if semiring == LARGEST:
        return 1.0 if part == whole else 0.0
    return math.exp(part - whole)


@inner
def _back(
    semiring: int, total: float, m: int, n: int, length: int, rows: Array, messages: Array, spread: Array,
    uniforms: Array, joint: Array, ended: Array, callers: Array, actors: Array, above: Array,
) -> None:  # fmt: skip
    """Fill a path from its last step to its first.

    A number uniform in [0, 1) takes the first part of the mass up to which the shares sum to more.
    """
    entry, left = 0, uniforms[n, m, length, 0]
    for s in range(len(actors)):
        left -= _share(semiring, messages[length, s], total)
        if left < 0:
            entry = s
            break
    for t in range(length - 1, -1, -1):
        level = 0
        joint[n, m, t] = entry
        while entry < len(above):
            i = above[entry] - len(actors)
            j = entry - callers[i, 0]
            if t > 0 and j > 0:
                kept = messages[t, entry] + rows[n, t, callers[i, 3] + 2 * j - 2]
                if uniforms[n, m, t, level] < _share(semiring, kept, spread[t, entry]):
                    break
            entry = above[entry]
            level += 1
        ended[n, m, t] = level
        for d in range(level - 1 if t > 0 else -1, -1, -1):
            i, mass = entry - len(actors), messages[t, entry]
            left = uniforms[n, m, t, uniforms.shape[3] // 2 + d]
            entry = callers[i, 0]
            for j in range(callers[i, 1]):
                part = messages[t, callers[i, 0] + j]
                if j > 0:
                    part += rows[n, t, callers[i, 3] + 2 * j - 1]
                left -= _share(semiring, part, mass)
                if left < 0:
                    entry = callers[i, 0] + j
                    break


@entry
def trace(
    semiring: int, lengths: Array, rows: Array, uniforms: Array, predicted: Array, joint: Array, ended: Array,
    possible: Array, messages: Array, spread: Array, columns: int, callers: Array, actors: Array,
    choices: Array, above: Array,
) -> None:  # fmt: skip
    """Fill the ``joint`` choices [N, M, T] of M paths, and how many levels ``ended`` before each. Paths are
    the most likely one (:data:`LARGEST`), or draws from p(ζ | ξ) (:data:`LOG_SUM`).

    ``possible`` [N] says which trajectories have a probability above 0; others have no paths.

    :param rows: log-probabilities, [N, T, columns].
    :param uniforms: numbers uniform in [0, 1), [N, M, 1 + T, 2·D]; zeros for the most likely path.
    :param predicted: filled with the log-probabilities of joint choices before the control of each step, [N,
        T, S]; [N, 0, S] where they are not wanted.
    """
    for n in range(len(lengths)):
        for i in range(messages.shape[1]):
            messages[0, i] = -np.inf
        messages[0, messages.shape[1] - 1] = 0.0  # at t = 0 everything is selected
        total = 0.0
        for t in range(lengths[n]):
            _predict(semiring, t, n, rows, messages, spread, callers, actors)
            for s in range(len(actors) if predicted.shape[1] > 0 else 0):
                predicted[n, t, s] = spread[t, s] - total
            total = _act(semiring, t, n, rows, columns, messages, spread, actors)
        possible[n] = total > -np.inf
        for m in range(joint.shape[1] if possible[n] else 0):
            _back(
                semiring, total, m, n, lengths[n], rows, messages, spread, uniforms, joint, ended, callers,
                actors, above,
            )  # fmt: skip


@entry
def products(x: Array, first: int, pairs: Array) -> None:
    """Products of each two rows of x [F, T] from a column on: a lower triangle [F·(F + 1) / 2, B]."""
    place, last = 0, first + pairs.shape[1]
    for i in range(len(x)):
        for j in range(i + 1):
            one, other, both = x[i, first:last], x[j, first:last], pairs[place]
            for t in range(len(one)):
                both[t] = np.float64(one[t]) * np.float64(other[t])
            place += 1
