"""Forward-backward over the chain's joint choices in scaled probability space, compiled; O(D·S) a step.

Trajectories are independent and go in parallel; within one, everything that a step needs lies close together, which
matters more than the arithmetic. :class:`ddco_pyro.inference.structure.Structure` says what the index arrays mean.

A trajectory's ``messages`` [1 + T, messages] hold, in row t, the filtered probabilities of the joint choices at t - 1
(level 1's message), then the mass that goes up from them at t: what terminated at every level below 2, ..., D + 1.
Its ``spread`` [T, messages] holds, for levels D + 1 to 2, what comes down again: what terminated, spread by the
selections, and what was kept.
"""

from __future__ import annotations

import numba
import numpy as np

Array = np.ndarray
Choices = tuple[int, ...]
"""Tuples, not arrays: the compiler then knows the depth, and keeps them in registers."""

TOLERANCE = 1e-9
"""Of Σ_s α_t(s) β_t(s), which rounding changes by less than 1e-12 over 10 000 steps."""

jit = numba.njit(cache=True, error_model="numpy")


@jit
def _up(n: int, t: int, messages: Array, end: Array, sizes: Choices, starts: Choices, ends: Choices) -> None:
    """Fill row t of ``messages`` for levels 2 to D + 1."""
    for d in range(len(sizes)):
        c = sizes[d]
        below = starts[d]
        for above in range(starts[d + 1], starts[d + 1] + (starts[d + 1] - starts[d]) // c):
            total = messages[t, below]  # choice 0 lasts one step
            for j in range(1, c):
                total += messages[t, below + j] * end[n, t, ends[d] + 2 * j - 1]
            messages[t, above] = total
            below += c


@jit
def _down(
    n: int, t: int, messages: Array, spread: Array, select: Array, end: Array, sizes: Choices, starts: Choices,
    selects: Choices, ends: Choices,
) -> None:  # fmt: skip
    """Fill row t of ``spread`` for levels D + 1 to 2."""
    depth = len(sizes)
    spread[t, starts[depth]] = messages[t, starts[depth]]
    for d in range(depth - 1, 0, -1):
        c = sizes[d]
        callers = sizes[d + 1] if d + 1 < depth else 0
        below, caller = starts[d], 0 if callers else 1
        for above in range(starts[d + 1], starts[d + 1] + (starts[d + 1] - starts[d]) // c):
            mass = spread[t, above]
            if caller == 0:
                spread[t, below] = mass
                spread[t, below + 1 : below + c] = 0.0
            else:
                row = selects[d] + (caller - 1) * c
                spread[t, below] = mass * select[n, t, row]
                for j in range(1, c):
                    kept = messages[t, below + j] * end[n, t, ends[d] + 2 * j - 2]
                    spread[t, below + j] = mass * select[n, t, row + j] + kept
            below += c
            caller += 1
            if caller >= callers:
                caller = 0 if callers else 1


@jit
def _act(
    n: int, t: int, messages: Array, spread: Array, select: Array, end: Array, emission: Array, weight: Array,
    sizes: Choices, starts: Choices, actors: Array,
) -> float:  # fmt: skip
    """Fill level 1 of row t + 1 of ``messages``, not yet normalised; its sum. The last of :func:`_down`, times the
    likelihood of the control.
    """
    c, total = sizes[0], 0.0
    weighted = weight.shape[2] > 0
    callers = sizes[1] if len(sizes) > 1 else 0
    below, caller = 0, 0 if callers else 1
    for above in range(starts[1], starts[1] + starts[1] // c):
        mass = spread[t, above]
        first = mass * emission[n, t, actors[below]]
        if weighted:
            first *= weight[n, t, below]
        if caller == 0:
            messages[t + 1, below + 1 : below + c] = 0.0
        else:
            row = (caller - 1) * c
            first *= select[n, t, row]
            for j in range(1, c):
                kept = messages[t, below + j] * end[n, t, 2 * j - 2]
                message = (mass * select[n, t, row + j] + kept) * emission[n, t, j - 1]
                if weighted:
                    message *= weight[n, t, below + j]
                messages[t + 1, below + j] = message
                total += message
        messages[t + 1, below] = first
        total += first
        below += c
        caller += 1
        if caller >= callers:
            caller = 0 if callers else 1
    return total


@jit
def _adjoint_act(
    n: int, t: int, messages: Array, spread: Array, back: Array, select: Array, emission: Array, weight: Array,
    scale: float, selected: Array, emitted: Array, sizes: Choices, starts: Choices, actors: Array,
) -> float:  # fmt: skip
    """Adjoint of :func:`_act` but for what was kept; Σ_s α_t(s) β_t(s).

    ``back`` holds β_t at level 1; there it becomes the adjoint of what came down, and at level 2 that of ``spread``.
    """
    c, total = sizes[0], 0.0
    weighted = weight.shape[2] > 0
    callers = sizes[1] if len(sizes) > 1 else 0
    below, caller = 0, 0 if callers else 1
    for above in range(starts[1], starts[1] + starts[1] // c):
        actor = actors[below]
        both = messages[t + 1, below] * back[below]
        total += both
        emitted[actor] += both
        first = back[below] * emission[n, t, actor] * scale
        if weighted:
            first *= weight[n, t, below]
        if caller > 0:
            mass, row = spread[t, above], (caller - 1) * c
            first *= select[n, t, row]
            selected[row] += mass * first
            for j in range(1, c):
                both = messages[t + 1, below + j] * back[below + j]
                total += both
                emitted[j - 1] += both
                here = back[below + j] * emission[n, t, j - 1] * scale
                if weighted:
                    here *= weight[n, t, below + j]
                back[below + j] = here
                term = here * select[n, t, row + j]
                first += term
                selected[row + j] += mass * term
        back[above] = first
        below += c
        caller += 1
        if caller >= callers:
            caller = 0 if callers else 1
    return total


@jit
def _adjoint_down(
    n: int, t: int, spread: Array, back: Array, select: Array, selected: Array, sizes: Choices, starts: Choices,
    selects: Choices,
) -> None:  # fmt: skip
    """Adjoint of the selections in :func:`_down`: ``back`` of levels 3 to D + 1 from level 2's."""
    depth = len(sizes)
    for d in range(1, depth):
        c = sizes[d]
        callers = sizes[d + 1] if d + 1 < depth else 0
        below, caller = starts[d], 0 if callers else 1
        for above in range(starts[d + 1], starts[d + 1] + (starts[d + 1] - starts[d]) // c):
            total = back[below]
            if caller > 0:
                mass, row, total = spread[t, above], selects[d] + (caller - 1) * c, 0.0
                for j in range(c):
                    term = back[below + j] * select[n, t, row + j]
                    total += term
                    selected[row + j] += mass * term
            back[above] = total
            below += c
            caller += 1
            if caller >= callers:
                caller = 0 if callers else 1


@jit
def _adjoint_up(
    n: int, t: int, messages: Array, back: Array, end: Array, ended: Array, sizes: Choices, starts: Choices,
    ends: Choices,
) -> None:  # fmt: skip
    """Adjoint of :func:`_up` and of what :func:`_down` keeps: ``back`` becomes the adjoint of row t of ``messages``."""
    for d in range(len(sizes) - 1, -1, -1):
        c = sizes[d]
        below = starts[d]
        for above in range(starts[d + 1], starts[d + 1] + (starts[d + 1] - starts[d]) // c):
            over = back[above]
            back[below] = over
            for j in range(1, c):
                column = ends[d] + 2 * (j - 1)
                mass = messages[t, below + j]
                keeping, stopping = back[below + j] * end[n, t, column], over * end[n, t, column + 1]
                ended[column] += mass * keeping
                ended[column + 1] += mass * stopping
                back[below + j] = keeping + stopping
            below += c


@jit
def _hand_out(sums: Array, n: int, t: int, rows: Array) -> None:
    """Write what was summed up for a step where it belongs, and begin anew."""
    for column in range(len(sums)):
        rows[n, t, column] = sums[column]
        sums[column] = 0.0


@jit
def _marginals(alpha: Array, beta: Array, actors: Array, choices: Array, to_choice: Array) -> None:
    """Fill ``to_choice`` [Σ C_d] with the choices' posterior probabilities at one step."""
    to_choice[:] = 0.0
    for s in range(len(actors)):
        if actors[s] >= 0:
            for d in range(choices.shape[1]):
                to_choice[choices[s, d]] += alpha[s] * beta[s]


@jit
def _forward(
    n: int, select: Array, end: Array, emission: Array, weight: Array, messages: Array, spread: Array, scale: Array,
    sizes: Choices, starts: Choices, selects: Choices, ends: Choices, actors: Array,
) -> float:  # fmt: skip
    """Fill ``messages``, ``spread`` and ``scale`` [T]; the log-likelihood, NaN where a step leaves no mass."""
    messages[0] = 0.0
    messages[0, starts[-1]] = 1.0  # at t = 0 everything is selected: all mass has terminated, none is kept
    value = 0.0
    for t in range(len(scale)):
        if t > 0:
            _up(n, t, messages, end, sizes, starts, ends)
        _down(n, t, messages, spread, select, end, sizes, starts, selects, ends)
        total = _act(n, t, messages, spread, select, end, emission, weight, sizes, starts, actors)
        value += np.log(total) if total > 0.0 else np.nan
        scale[t] = 1.0 / total
        for s in range(len(actors)):
            messages[t + 1, s] *= scale[t]
    return value


@jit
def _backward(
    n: int, select: Array, end: Array, emission: Array, weight: Array, messages: Array, spread: Array, scale: Array,
    to_select: Array, to_end: Array, to_emission: Array, to_choice: Array, sizes: Choices, starts: Choices,
    selects: Choices, ends: Choices, actors: Array, choices: Array,
) -> bool:  # fmt: skip
    """Fill the posteriors; whether Σ_s α_t(s) β_t(s) = 1 at every step: so it is but for what underflow has lost."""
    back = np.ones(starts[-1] + 1)  # level 1: β
    selected, ended, emitted = np.zeros(select.shape[2]), np.zeros(end.shape[2]), np.zeros(emission.shape[2])
    exact = True
    for t in range(len(scale) - 1, -1, -1):
        if to_choice.shape[2]:
            _marginals(messages[t + 1], back, actors, choices, to_choice[n, t])
        total = _adjoint_act(
            n, t, messages, spread, back, select, emission, weight, scale[t], selected, emitted, sizes, starts, actors
        )
        exact &= abs(total - 1.0) <= TOLERANCE  # NaN is not
        _adjoint_down(n, t, spread, back, select, selected, sizes, starts, selects)
        if t > 0:
            _adjoint_up(n, t, messages, back, end, ended, sizes, starts, ends)
        _hand_out(selected, n, t, to_select)
        _hand_out(ended, n, t, to_end)
        _hand_out(emitted, n, t, to_emission)
    for adjoint in back:  # at t = 0 nothing else would tell that it has overflowed
        exact &= np.isfinite(adjoint)
    return exact


@jit
def subtract_largest(rows: Array, lengths: Array, shift: Array) -> None:
    """Subtract from each step's log-densities the largest, if it is finite; ``shift`` [N] is what they sum to."""
    for n in range(len(rows)):
        shift[n] = 0.0
        for t in range(rows.shape[1]):
            top = rows[n, t, 0]
            for j in range(1, rows.shape[2]):
                top = max(top, rows[n, t, j])
            if np.isfinite(top):
                for j in range(rows.shape[2]):
                    rows[n, t, j] -= top
                if t < lengths[n]:
                    shift[n] += top


@numba.njit(cache=True, parallel=True, error_model="numpy")
def forward_backward(
    select: Array, end: Array, emission: Array, weight: Array, lengths: Array, value: Array, exact: Array,
    to_select: Array, to_end: Array, to_emission: Array, to_choice: Array, sizes: Choices, starts: Choices,
    selects: Choices, ends: Choices, actors: Array, choices: Array,
) -> None:  # fmt: skip
    """Fill log-likelihoods ``value`` [N], whether they are ``exact`` [N], and the posteriors ``to_...``.

    :param select: selection probabilities [N, T, Σ callers·C_d].
    :param end: termination probabilities [N, T, Σ 2·k_d].
    :param emission: the controls' densities, scaled at each step, [N, T, 1 + Σ k_d].
    :param weight: factors of the joint choices [N, T, S], or [N, T, 0] where there are none.
    :param to_select: like ``select``; ``to_end`` and ``to_emission`` accordingly.
    :param to_choice: the choices' marginals, [N, T, Σ C_d], or [N, T, 0] where they are not wanted.
    """
    for n in numba.prange(len(lengths)):
        messages = np.empty((1 + lengths[n], starts[-1] + 1))
        spread = np.empty((lengths[n], starts[-1] + 1))
        scale = np.empty(lengths[n])
        value[n] = _forward(
            n, select, end, emission, weight, messages, spread, scale, sizes, starts, selects, ends, actors
        )  # fmt: skip
        exact[n] = _backward(
            n, select, end, emission, weight, messages, spread, scale, to_select, to_end, to_emission, to_choice,
            sizes, starts, selects, ends, actors, choices,
        )  # fmt: skip
        to_select[n, lengths[n] :] = 0.0
        to_end[n, lengths[n] :] = 0.0
        to_emission[n, lengths[n] :] = 0.0
        to_choice[n, lengths[n] :] = 0.0
