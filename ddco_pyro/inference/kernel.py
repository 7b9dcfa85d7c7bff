"""The recursions of the AHMM over a trajectory, compiled; O(D·S) a step for S joint choices.

:func:`_predict` and :func:`_act` are the forward recursion in any semiring. :func:`eliminate` runs them over
probabilities and goes back for the gradient. :func:`trace` runs them over logarithms and goes back along paths.

:class:`Structure` numbers joint choices and messages. Row t of ``messages`` [1 + T, M] begins with the forward mass of
the joint choices at t - 1. Above level 1 the row has the mass that terminated at every level below, at t. Row t of
``spread`` [T, M] has the mass that comes down again: the selected mass and the kept mass.

Tables of all levels stand side by side in rows [N·T, columns]: selections, terminations, the meta-policy's control, the
options' controls, and factors of the joint choices where there is evidence.

All compiled functions are in this file, so that numba's cache, which looks at the file of an entry point, is right.
Arrays are allocated by callers and indexed in full: numba takes seconds to compile allocations and slices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
import torch

Array = np.ndarray

IMPOSSIBLE = -1
"""Marks a joint choice with an option below a choice 0, and a caller that is itself below a choice 0."""

TOLERANCE = 1e-9
"""Allowed error of Σ_s α_t(s) β_t(s) = 1. Rounding changes the sum by less than 1e-12 over 10 000 steps."""

ROUNDED = 1e-7
"""Products of the masses of steps above it are multiplied on, since the logarithm of each takes longer."""

SMALL, LARGE = 1e-300, 1e300
"""Mass of a step, and backward messages, beyond which a trajectory is done in log space."""

STEPS_A_THREAD = 4096
"""Steps of trajectories that are worth a thread of their own."""


class Structure(NamedTuple):
    """Index tables of D levels, lowest first. C_d = 1 + k_d counts a level's choices, control among them.

    A joint choice is one index, with h^D as the slowest digit and h^1 as the fastest. A *message* of level d runs over
    (h^D, ..., h^d). The messages of levels 1 to D + 1 stand one after the other, M entries in all; level D + 1 has one.

    :param columns: of a row, without the factors of joint choices.
    :param callers: for each message entry above level 1: its first entry below, the number C of entries below, its
        first column in a row as their caller, and the column of their first termination; [M - S, 4]. A caller below a
        choice 0 has no column, but :data:`IMPOSSIBLE`.
    :param actors: for each joint choice, the acting caller's column; :data:`IMPOSSIBLE` where the joint choice is, [S].
    :param choices: for each joint choice, the columns of its choices in a row of posteriors, which has marginals in
        place of the factors, [S, D].
    :param above: for each message entry below level D + 1, the entry of its caller, [M - 1].
    """

    columns: int
    callers: Array
    actors: Array
    choices: Array
    above: Array

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
        return cls(columns, np.concatenate(callers), actors, choices, np.concatenate(above))

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


def on_threads(run: Callable[[int, int], object], lengths: Array) -> None:
    """Call ``run(first, last)`` for parts of the trajectories, on at most ``torch.get_num_threads()`` threads.

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


inner = numba.njit(error_model="numpy", fastmath={"contract"}, inline="always")
entry: Callable[[Callable[..., None]], Callable[..., None]] = numba.njit(  # numba's own type knows no unpacking
    error_model="numpy", fastmath={"contract"}, nogil=True, cache=True
)

SUM, LOG_SUM, LARGEST = range(3)
"""Semirings: sums of probabilities; sums, and maxima, of their logarithms."""


@inner
def _plus(semiring: int, first: float, second: float) -> float:
    if semiring == SUM:
        return first + second
    larger, smaller = (first, second) if first >= second else (second, first)
    if semiring == LARGEST or smaller == -np.inf:
        return larger
    return larger + math.log(1.0 + math.exp(smaller - larger))


@inner
def _times(semiring: int, first: float, second: float) -> float:
    return first * second if semiring == SUM else first + second


@inner
def _begin(semiring: int, messages: Array) -> None:
    """Fill ``messages[0]``: at t = 0 everything is selected."""
    for i in range(messages.shape[1]):
        messages[0, i] = 0.0 if semiring == SUM else -np.inf
    messages[0, messages.shape[1] - 1] = 1.0 if semiring == SUM else 0.0


@inner
def _predict(
    semiring: int, t: int, row: int, rows: Array, messages: Array, spread: Array, callers: Array, actors: Array
) -> None:
    """Fill ``messages[t]`` above level 1 and ``spread[t]``: the mass of each joint choice before the control at t.

    :param row: of the trajectory's step t.
    """
    last, zero = len(callers) - 1, 0.0 if semiring == SUM else -np.inf
    if t > 0:
        for i in range(len(callers)):
            below, ends = callers[i, 0], callers[i, 3]
            total = messages[t, below]  # choice 0 lasts one step
            for j in range(1, callers[i, 1]):
                ended = _times(semiring, messages[t, below + j], rows[row, ends + 2 * j - 1])
                total = _plus(semiring, total, ended)
            messages[t, len(actors) + i] = total
    spread[t, len(actors) + last] = messages[t, len(actors) + last]
    for i in range(last, -1, -1):
        below, calls, ends, mass = callers[i, 0], callers[i, 2], callers[i, 3], spread[t, len(actors) + i]
        spread[t, below] = mass if calls < 0 else _times(semiring, mass, rows[row, calls])
        for j in range(1, callers[i, 1]):
            arrived = zero
            if calls >= 0:
                arrived = _times(semiring, mass, rows[row, calls + j])
                if t > 0:
                    kept = _times(semiring, messages[t, below + j], rows[row, ends + 2 * j - 2])
                    arrived = _plus(semiring, arrived, kept)
            spread[t, below + j] = arrived


@inner
def _act(
    semiring: int, t: int, row: int, rows: Array, columns: int, messages: Array, spread: Array, actors: Array
) -> float:
    """Fill level 1 of ``messages[t + 1]``: the mass of each joint choice and the control at t. Its sum."""
    zero, weighted = 0.0 if semiring == SUM else -np.inf, rows.shape[1] > columns
    total = zero
    for s in range(len(actors)):
        mass = zero
        if actors[s] >= 0:
            mass = _times(semiring, spread[t, s], rows[row, actors[s]])
            if weighted:
                mass = _times(semiring, mass, rows[row, columns + s])
            total = _plus(semiring, total, mass)
        messages[t + 1, s] = mass
    return total


@inner
def _adjoint_act(
    t: int, row: int, scale: float, rows: Array, columns: int, messages: Array, back: Array, posterior: Array,
    actors: Array, choices: Array,
) -> float:  # fmt: skip
    """Adjoint of :func:`_act`: level 1 of ``back`` goes from β_t to the adjoint of ``spread``. Σ_s α_t(s) β_t(s)."""
    total, weighted, marginals = 0.0, rows.shape[1] > columns, posterior.shape[1] > columns
    for s in range(len(actors)):
        if actors[s] < 0:
            back[s] = 0.0
        else:
            both = messages[t + 1, s] * back[s]
            total += both
            posterior[row, actors[s]] += both
            if marginals:
                for d in range(choices.shape[1]):
                    posterior[row, choices[s, d]] += both
            back[s] *= rows[row, actors[s]] * scale
            if weighted:
                back[s] *= rows[row, columns + s]
    return total


@inner
def _adjoint_predict(
    t: int, row: int, rows: Array, messages: Array, spread: Array, back: Array, posterior: Array, callers: Array,
    actors: Array,
) -> None:  # fmt: skip
    """Adjoint of :func:`_predict`: ``back`` goes from the adjoint of ``spread[t]`` to β of t - 1."""
    for i in range(len(callers)):
        below, calls, mass = callers[i, 0], callers[i, 2], spread[t, len(actors) + i]
        total = back[below]
        if calls >= 0:
            total = 0.0
            for j in range(callers[i, 1]):
                term = back[below + j] * rows[row, calls + j]
                total += term
                posterior[row, calls + j] += mass * term
        back[len(actors) + i] = total
    if t > 0:
        for i in range(len(callers) - 1, -1, -1):
            below, ends, over = callers[i, 0], callers[i, 3], back[len(actors) + i]
            back[below] = over
            for j in range(1, callers[i, 1]):
                keeping, ending = ends + 2 * j - 2, ends + 2 * j - 1
                kept, ended, mass = (
                    back[below + j] * rows[row, keeping],
                    over * rows[row, ending],
                    messages[t, below + j],
                )
                posterior[row, keeping] += mass * kept
                posterior[row, ending] += mass * ended
                back[below + j] = kept + ended


@entry
def eliminate(
    first: int, last: int, steps: int, lengths: Array, rows: Array, posterior: Array, value: Array, exact: Array,
    messages: Array, spread: Array, scales: Array, back: Array, columns: int, callers: Array, actors: Array,
    choices: Array, above: Array,
) -> None:  # fmt: skip
    """Of trajectories ``first`` to ``last``, fill ``value``, ``exact`` and the posteriors, which are 0 before.

    Each step is scaled to a mass of 1. Underflow there matters only where the past makes next to impossible what the
    future demands. Then Σ_s α_t(s) β_t(s) is not 1, and the trajectory is not ``exact``.

    :param steps: T.
    :param rows: probabilities.
    :param value: log p(ξ), [N]; ``exact`` likewise.
    :param messages: room, as ``spread``, ``scales`` [T] and ``back`` [M].
    """
    for n in range(first, last):
        _begin(SUM, messages)
        found, product, good = 0.0, 1.0, True
        for t in range(lengths[n]):
            row = n * steps + t
            _predict(SUM, t, row, rows, messages, spread, callers, actors)
            total = _act(SUM, t, row, rows, columns, messages, spread, actors)
            good = good and total >= SMALL
            product *= total
            if not product > ROUNDED:  # logarithms are slow; NaN is not larger
                found += math.log(product)
                product = 1.0
            scales[t] = 1.0 / total
            for s in range(len(actors)):
                messages[t + 1, s] *= scales[t]
        for i in range(len(back)):
            back[i] = 1.0
        for t in range(lengths[n] - 1, -1, -1):
            row = n * steps + t
            both = _adjoint_act(t, row, scales[t], rows, columns, messages, back, posterior, actors, choices)
            good = good and abs(both - 1.0) <= TOLERANCE  # NaN is not
            _adjoint_predict(t, row, rows, messages, spread, back, posterior, callers, actors)
        for i in range(len(back)):  # an overflow at t = 0 shows nowhere else
            good = good and back[i] <= LARGE
        value[n], exact[n] = found + math.log(product), good


@entry
def predict(
    first: int, last: int, steps: int, lengths: Array, rows: Array, predicted: Array, messages: Array, spread: Array,
    columns: int, callers: Array, actors: Array, choices: Array, above: Array,
) -> None:  # fmt: skip
    """Of trajectories ``first`` to ``last``, fill the ``predicted`` log-probabilities [N·T, S] of joint choices before
    the control of each step.

    :param rows: log-probabilities.
    """
    for n in range(first, last):
        _begin(LOG_SUM, messages)
        before = 0.0
        for t in range(lengths[n]):
            row = n * steps + t
            _predict(LOG_SUM, t, row, rows, messages, spread, callers, actors)
            for s in range(len(actors)):
                predicted[row, s] = spread[t, s] - before
            before = _act(LOG_SUM, t, row, rows, columns, messages, spread, actors)


@inner
def _share(semiring: int, part: float, whole: float) -> float:
    """The probability of a part of the mass, of logarithms; of a part of the maximum, 1 where it is the maximum."""
    if semiring == LARGEST:
        return 1.0 if part == whole else 0.0
    return math.exp(part - whole)


@inner
def _back(
    semiring: int, total: float, m: int, n: int, length: int, steps: int, rows: Array, messages: Array, spread: Array,
    uniforms: Array, joint: Array, ended: Array, callers: Array, actors: Array, above: Array,
) -> None:  # fmt: skip
    """Fill a path from its last step to its first.

    A number uniform in [0, 1) takes the first part of the mass up to which the shares sum to more.
    """
    entry, left = 0, uniforms[m, n, length, 0]
    for s in range(len(actors)):
        left -= _share(semiring, messages[length, s], total)
        if left < 0:
            entry = s
            break
    for t in range(length - 1, -1, -1):
        row, level = n * steps + t, 0
        joint[m, n, t] = entry
        while entry < len(above):
            i = above[entry] - len(actors)
            j = entry - callers[i, 0]
            if t > 0 and j > 0:
                kept = messages[t, entry] + rows[row, callers[i, 3] + 2 * j - 2]
                if uniforms[m, n, t, level] < _share(semiring, kept, spread[t, entry]):
                    break
            entry = above[entry]
            level += 1
        ended[m, n, t] = level
        for d in range(level - 1 if t > 0 else -1, -1, -1):
            i, mass, left = entry - len(actors), messages[t, entry], uniforms[m, n, t, uniforms.shape[3] // 2 + d]
            entry = callers[i, 0]
            for j in range(callers[i, 1]):
                part = messages[t, callers[i, 0] + j]
                if j > 0:
                    part += rows[row, callers[i, 3] + 2 * j - 1]
                left -= _share(semiring, part, mass)
                if left < 0:
                    entry = callers[i, 0] + j
                    break


@entry
def trace(
    first: int, last: int, steps: int, semiring: int, lengths: Array, rows: Array, uniforms: Array, joint: Array,
    ended: Array, possible: Array, messages: Array, spread: Array, columns: int, callers: Array, actors: Array,
    choices: Array, above: Array,
) -> None:  # fmt: skip
    """Of trajectories ``first`` to ``last``, fill the ``joint`` choices [M, N, T] of M paths, and how many levels
    ``ended`` before each. Paths are the most likely one (:data:`LARGEST`), or draws from p(ζ | ξ) (:data:`LOG_SUM`).

    ``possible`` [N] says which trajectories have a probability above 0; nothing is filled for others.

    :param steps: T.
    :param rows: log-probabilities.
    :param uniforms: numbers uniform in [0, 1), [M, N, 1 + T, 2·D]; zeros for the most likely path.
    """
    for n in range(first, last):
        _begin(semiring, messages)
        total = -np.inf
        for t in range(lengths[n]):
            row = n * steps + t
            _predict(semiring, t, row, rows, messages, spread, callers, actors)
            total = _act(semiring, t, row, rows, columns, messages, spread, actors)
        possible[n] = total > -np.inf
        if possible[n]:
            for m in range(len(joint)):
                _back(
                    semiring, total, m, n, lengths[n], steps, rows, messages, spread, uniforms, joint, ended, callers,
                    actors, above,
                )  # fmt: skip


@entry
def products(x: Array, pairs: Array) -> None:
    """The products of each two columns of x [B, F] into the rows of ``pairs``: the lower triangle, row by row."""
    for t in range(len(x)):
        place = 0
        for i in range(x.shape[1]):
            for j in range(i + 1):
                pairs[t, place + j] = x[t, i] * x[t, j]
            place += i + 1
