"""Forward-backward over the joint choices of a hierarchy in scaled probability space, compiled; O(D·S) a step.

Trajectories run in parallel. Within one trajectory the arrays of a step lie close together in memory, which matters
more than the arithmetic. :class:`Structure` defines how joint choices and messages are numbered.

Row t of ``messages`` [1 + T, messages] begins with the filtered probabilities of the joint choices at t - 1. Above
level 1 the row holds the mass that goes up from them at t: the mass that terminated at every level below.
Row t of ``spread`` [T, messages] holds the mass that comes down again, for levels D + 1 to 2: the terminated mass,
spread by the selections, and the kept mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
import torch

from ddco_pyro.model.elementary import Array, exponentials

IMPOSSIBLE = -1
"""Marks a joint choice with an option below a choice 0, and a caller that is itself below a choice 0."""

TOLERANCE = 1e-9
"""Allowed error of Σ_s α_t(s) β_t(s) = 1. Rounding changes the sum by less than 1e-12 over 10 000 steps."""

STEPS_A_THREAD = 4096
"""Steps of trajectories that are worth a thread of their own."""

SMALL = 1e-150
"""Logarithms of products are taken before the product of two such numbers underflows."""

jit = numba.njit(cache=True, error_model="numpy", forceinline=True)
releasing = numba.njit(cache=True, error_model="numpy", nogil=True)


class Structure(NamedTuple):
    """Index tables of D levels, lowest first. C_d = 1 + k_d counts a level's choices, control among them.

    A joint choice is one index, with h^D as the slowest digit and h^1 as the fastest. A *message* of level d runs over
    (h^D, ..., h^d). The messages of levels 1 to D + 1 stand one after the other; level D + 1 has a single entry.
    Each row of a table holds the levels side by side. The tuples let the compiler unroll loops over levels.

    :param sizes: C_d, [D].
    :param starts: first index of each level's message, and the number of all entries, [D + 2].
    :param ends: first column of each level in a row of terminations, where a level has [k_d, 2], [D].
    :param callers: for each message entry, its first column in a row of selections as the caller of the level below,
        where a level has [callers, C_d]; :data:`IMPOSSIBLE` for a caller below a choice 0.
    :param actors: for each joint choice, the acting caller's column in a row of controls, [S]. A row has the
        meta-policy, then each level's k_d options; the column is :data:`IMPOSSIBLE` where the joint choice is.
    :param choices: for each joint choice, the columns of its choices in a row of marginals, [S, D].
    """

    sizes: tuple[int, ...]
    starts: tuple[int, ...]
    ends: tuple[int, ...]
    callers: Array
    actors: Array
    choices: Array

    @classmethod
    @lru_cache
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
            sizes=sizes,
            starts=_offsets(messages),
            ends=_offsets([2 * (size - 1) for size in sizes])[:-1],
            callers=np.concatenate(callers),
            actors=actors,
            choices=np.ascontiguousarray(digits + np.array(_offsets(sizes)[:-1])),
        )

    def digits(self, joint: Array) -> tuple[Array, ...]:
        """The choice of each level, lowest first, in joint choices of any shape."""
        choices = []
        for size in self.sizes:
            choices.append(joint % size)
            joint = joint // size
        return tuple(choices)


def _offsets(sizes: Sequence[int]) -> tuple[int, ...]:
    """Where each of consecutive parts begins, and where the last one ends."""
    return tuple(np.cumsum([0, *sizes]).tolist())


class Rows(NamedTuple):
    """Tables of all levels side by side, [M, ...]: a row for each step of all trajectories, one after the other.

    :param selection: selection probabilities, [M, Σ callers·C_d].
    :param termination: termination probabilities, [M, Σ 2·k_d].
    :param control: densities of the controls, scaled at each step, [M, 1 + Σ k_d].
    :param choice: factors of the joint choices, [M, S]; among posteriors, the marginals of the choices, [M, Σ C_d].
        The last dimension is 0 where there are none.
    """

    selection: Array
    termination: Array
    control: Array
    choice: Array


def on_threads(run: Callable[[int, int], object], lengths: Array) -> None:
    """Call ``run(first, last)`` for parts of the trajectories, on at most ``torch.get_num_threads()`` threads."""
    number = len(lengths)
    threads = min(torch.get_num_threads(), number, 1 + int(lengths.sum()) // STEPS_A_THREAD)
    if threads == 1:
        run(0, number)
        return
    bounds = [number * part // threads for part in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(run, bounds[:-1], bounds[1:]))


@jit
def trajectory(rows: Rows, start: int, steps: int) -> Rows:
    """The rows of the trajectory of so many steps that begins at row ``start``."""
    own = slice(start, start + steps)
    return Rows(rows.selection[own], rows.termination[own], rows.control[own], rows.choice[own])


@jit
def _up(t: int, rows: Rows, messages: Array, of: Structure) -> None:
    """Fill row t of ``messages`` for levels 2 to D + 1."""
    for d in range(len(of.sizes)):
        c, below = of.sizes[d], of.starts[d]
        for above in range(of.starts[d + 1], of.starts[d + 2]):
            total = messages[t, below]  # choice 0 lasts one step
            for j in range(1, c):
                total += messages[t, below + j] * rows.termination[t, of.ends[d] + 2 * j - 1]
            messages[t, above] = total
            below += c


@jit
def _down(t: int, rows: Rows, messages: Array, spread: Array, of: Structure) -> None:
    """Fill row t of ``spread`` for levels D + 1 to 2."""
    depth = len(of.sizes)
    spread[t, of.starts[depth]] = messages[t, of.starts[depth]]
    for d in range(depth - 1, 0, -1):
        c, below = of.sizes[d], of.starts[d]
        for above in range(of.starts[d + 1], of.starts[d + 2]):
            mass, first = spread[t, above], of.callers[above]
            if first < 0:
                spread[t, below] = mass
                spread[t, below + 1 : below + c] = 0.0
            else:
                spread[t, below] = mass * rows.selection[t, first]
                for j in range(1, c):
                    kept = messages[t, below + j] * rows.termination[t, of.ends[d] + 2 * j - 2]
                    spread[t, below + j] = mass * rows.selection[t, first + j] + kept
            below += c


@jit
def _act(t: int, rows: Rows, messages: Array, spread: Array, of: Structure) -> float:
    """Fill level 1 of row t + 1 of ``messages``, not yet normalised, and return its sum: the last step of
    :func:`_down`, times the likelihood of the control.
    """
    c, below, total = of.sizes[0], 0, 0.0
    weighted = rows.choice.shape[1] > 0
    for above in range(of.starts[1], of.starts[2]):
        mass, first = spread[t, above], of.callers[above]
        message = mass * rows.control[t, of.actors[below]]
        if weighted:
            message *= rows.choice[t, below]
        if first < 0:
            messages[t + 1, below + 1 : below + c] = 0.0
        else:
            message *= rows.selection[t, first]
            for j in range(1, c):
                kept = messages[t, below + j] * rows.termination[t, 2 * j - 2]
                option = (mass * rows.selection[t, first + j] + kept) * rows.control[t, j]
                if weighted:
                    option *= rows.choice[t, below + j]
                messages[t + 1, below + j] = option
                total += option
        messages[t + 1, below] = message
        total += message
        below += c
    return total


@jit
def _adjoint_act(
    t: int, rows: Rows, messages: Array, spread: Array, scale: float, back: Array, sums: Rows, of: Structure
) -> float:
    """Adjoint of :func:`_act` except for the kept mass; returns Σ_s α_t(s) β_t(s).

    ``back`` holds β_t at level 1. It becomes the adjoint of the mass that came down and, at level 2, of ``spread``.
    """
    c, below, total = of.sizes[0], 0, 0.0
    weighted = rows.choice.shape[1] > 0
    for above in range(of.starts[1], of.starts[2]):
        actor, first = of.actors[below], of.callers[above]
        both = messages[t + 1, below] * back[below]
        total += both
        sums.control[actor] += both
        over = back[below] * rows.control[t, actor] * scale
        if weighted:
            over *= rows.choice[t, below]
        if first >= 0:
            mass = spread[t, above]
            over *= rows.selection[t, first]
            sums.selection[first] += mass * over
            for j in range(1, c):
                both = messages[t + 1, below + j] * back[below + j]
                total += both
                sums.control[j] += both
                here = back[below + j] * rows.control[t, j] * scale
                if weighted:
                    here *= rows.choice[t, below + j]
                back[below + j] = here
                term = here * rows.selection[t, first + j]
                over += term
                sums.selection[first + j] += mass * term
        back[above] = over
        below += c
    return total


@jit
def _adjoint_down(t: int, rows: Rows, spread: Array, back: Array, sums: Rows, of: Structure) -> None:
    """Adjoint of the selections in :func:`_down`: ``back`` of levels 3 to D + 1 from level 2's."""
    for d in range(1, len(of.sizes)):
        c, below = of.sizes[d], of.starts[d]
        for above in range(of.starts[d + 1], of.starts[d + 2]):
            first = of.callers[above]
            if first < 0:
                back[above] = back[below]
            else:
                mass, total = spread[t, above], 0.0
                for j in range(c):
                    term = back[below + j] * rows.selection[t, first + j]
                    total += term
                    sums.selection[first + j] += mass * term
                back[above] = total
            below += c


@jit
def _adjoint_up(t: int, rows: Rows, messages: Array, back: Array, sums: Rows, of: Structure) -> None:
    """Adjoint of :func:`_up` and of the kept mass in :func:`_down`: ``back`` becomes that of row t of ``messages``."""
    for d in range(len(of.sizes) - 1, -1, -1):
        c, below = of.sizes[d], of.starts[d]
        for above in range(of.starts[d + 1], of.starts[d + 2]):
            over = back[above]
            back[below] = over
            for j in range(1, c):
                column = of.ends[d] + 2 * (j - 1)
                mass = messages[t, below + j]
                keeping = back[below + j] * rows.termination[t, column]
                stopping = over * rows.termination[t, column + 1]
                sums.termination[column] += mass * keeping
                sums.termination[column + 1] += mass * stopping
                back[below + j] = keeping + stopping
            below += c


@jit
def _flush(sums: Array, row: Array) -> None:
    """Write the sums of one step and reset them."""
    for column in range(len(sums)):
        row[column] = sums[column]
        sums[column] = 0.0


@jit
def _forward(rows: Rows, messages: Array, spread: Array, scale: Array, of: Structure) -> float:
    """Fill ``messages``, ``spread`` and ``scale`` [T]; the log-likelihood, NaN where a step leaves no mass."""
    messages[0] = 0.0
    messages[0, of.starts[len(of.sizes)]] = 1.0  # at t = 0 everything is selected
    value = 0.0
    for t in range(len(scale)):
        if t > 0:
            _up(t, rows, messages, of)
        _down(t, rows, messages, spread, of)
        total = _act(t, rows, messages, spread, of)
        value += np.log(total) if total > 0.0 else np.nan
        scale[t] = 1.0 / total
        for s in range(len(of.actors)):
            messages[t + 1, s] *= scale[t]
    return value


@jit
def _backward(rows: Rows, messages: Array, spread: Array, scale: Array, posterior: Rows, of: Structure) -> bool:
    """Fill the posteriors; whether Σ_s α_t(s) β_t(s) = 1 at every step, which only underflow can change."""
    back = np.ones(messages.shape[1])  # level 1: β
    none = np.zeros(0)
    sums = Rows(
        np.zeros(rows.selection.shape[1]), np.zeros(rows.termination.shape[1]), np.zeros(rows.control.shape[1]), none
    )
    exact = True
    for t in range(len(scale) - 1, -1, -1):
        if posterior.choice.shape[1]:
            posterior.choice[t] = 0.0
            for s in range(len(of.actors)):
                if of.actors[s] >= 0:
                    for d in range(of.choices.shape[1]):
                        posterior.choice[t, of.choices[s, d]] += messages[t + 1, s] * back[s]
        total = _adjoint_act(t, rows, messages, spread, scale[t], back, sums, of)
        exact &= abs(total - 1.0) <= TOLERANCE  # NaN is not
        _adjoint_down(t, rows, spread, back, sums, of)
        if t > 0:
            _adjoint_up(t, rows, messages, back, sums, of)
        _flush(sums.selection, posterior.selection[t])
        _flush(sums.termination, posterior.termination[t])
        _flush(sums.control, posterior.control[t])
    for adjoint in back:  # an overflow at t = 0 shows nowhere else
        exact &= np.isfinite(adjoint)
    return exact


@releasing
def any_levels(
    first: int, last: int, rows: Rows, starts: Array, lengths: Array, value: Array, exact: Array, posteriors: Rows,
    of: Structure,
) -> None:  # fmt: skip
    """Of trajectories ``first`` to ``last``, fill log-likelihoods ``value`` [N], whether they are ``exact`` [N], and
    the posteriors of the rows.

    :param starts: the first row of each trajectory, [N].
    """
    for n in range(first, last):
        steps, own = lengths[n], trajectory(rows, starts[n], lengths[n])
        messages, spread = np.empty((1 + steps, of.starts[-1])), np.empty((steps, of.starts[-1]))
        scale = np.empty(steps)
        value[n] = _forward(own, messages, spread, scale, of)
        exact[n] = _backward(own, messages, spread, scale, trajectory(posteriors, starts[n], steps), of)


# One level is the common case, and four times faster on its own: nothing goes up or comes down. Its ``messages``
# [1 + T, C] hold in row t the distribution of the choice at t - 1 before normalisation, so that a step need not wait
# for the division. ``ended`` [T] is the mass that terminated at t. Column j of a row of controls is that of choice j.


@jit
def _forward_one(rows: Rows, messages: Array, ended: Array, scale: Array) -> float:
    """Fill ``messages``, ``ended`` and ``scale`` [T]; the log-likelihood, NaN where a step leaves no mass."""
    select, end = rows.selection, rows.termination
    steps, c = rows.control.shape
    messages[0] = 0.0
    messages[0, 0] = 1.0  # at t = 0 everything is selected
    value, before, product = 0.0, 1.0, 1.0
    for t in range(steps):
        mass = messages[t, 0]
        for j in range(1, c):
            mass += messages[t, j] * end[t, 2 * j - 1]
        mass *= before
        ended[t] = mass
        total = mass * select[t, 0] * rows.control[t, 0]
        messages[t + 1, 0] = total
        for j in range(1, c):
            kept = messages[t, j] * before * end[t, 2 * j - 2]
            message = (mass * select[t, j] + kept) * rows.control[t, j]
            messages[t + 1, j] = message
            total += message
        if total < SMALL:
            value += np.log(total) if total > 0.0 else np.nan
        else:
            product *= total
            if product < SMALL:
                value += np.log(product)
                product = 1.0
        before = 1.0 / total
        scale[t] = before
    return value + np.log(product)


@jit
def _backward_one(rows: Rows, messages: Array, ended: Array, scale: Array, posterior: Rows) -> bool:
    """:func:`_backward` for one level; the marginals of choices are the posteriors of controls."""
    select, end = rows.selection, rows.termination
    steps, c = rows.control.shape
    back, exact = np.ones(c), True
    for t in range(steps - 1, -1, -1):
        mass, total, over = ended[t], 0.0, 0.0
        for j in range(c):
            beta = back[j] * scale[t]
            both = messages[t + 1, j] * beta
            total += both
            posterior.control[t, j] = both
            back[j] = beta * rows.control[t, j]
            term = back[j] * select[t, j]
            over += term
            posterior.selection[t, j] = mass * term
        exact &= abs(total - 1.0) <= TOLERANCE and np.isfinite(over)  # NaN is not
        if t == 0:
            posterior.termination[0] = 0.0
            break
        back[0] = over
        for j in range(1, c):
            known = messages[t, j] * scale[t - 1]
            keeping, stopping = back[j] * end[t, 2 * j - 2], over * end[t, 2 * j - 1]
            posterior.termination[t, 2 * j - 2] = known * keeping
            posterior.termination[t, 2 * j - 1] = known * stopping
            back[j] = keeping + stopping
    return exact


@releasing
def one_level(
    first: int, last: int, rows: Rows, starts: Array, lengths: Array, value: Array, exact: Array, posteriors: Rows,
    _: Structure,
) -> None:  # fmt: skip
    """:func:`any_levels` for one level, whose factors of choices are in the controls."""
    for n in range(first, last):
        steps, own = lengths[n], trajectory(rows, starts[n], lengths[n])
        messages, ended, scale = np.empty((1 + steps, own.selection.shape[1])), np.empty(steps), np.empty(steps)
        value[n] = _forward_one(own, messages, ended, scale)
        exact[n] = _backward_one(own, messages, ended, scale, trajectory(posteriors, starts[n], steps))


@numba.njit(cache=True, error_model="numpy")
def scale_densities(rows: Array, starts: Array, lengths: Array, shift: Array) -> None:
    """Log-densities [M, n] to densities over the step's largest; ``shift`` [N] becomes the sum of its logarithms.

    A step without a finite largest is not scaled.
    """
    for n in range(len(lengths)):
        own, total = rows[starts[n] : starts[n] + lengths[n]], 0.0
        for t in range(len(own)):
            top = own[t, 0]
            for j in range(1, own.shape[1]):
                top = max(top, own[t, j])
            if np.isfinite(top):
                total += top
                for j in range(own.shape[1]):
                    own[t, j] -= top
        shift[n] = total
    exponentials(rows.reshape(-1))
