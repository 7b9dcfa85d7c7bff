"""Forward-backward over the chain's joint choices in scaled probability space, compiled; O(D·S) a step.

A joint choice is one index, h^D the slowest digit and h^1 the fastest. A message of level d runs over (h^D, ..., h^d);
level D + 1 stands for the single number of everything terminated. The tables of one step are flat rows with each level,
lowest first, after the other: selections [callers, C_d], terminations [C_d, 2].
"""

from __future__ import annotations

import numba
import numpy as np

Array = np.ndarray

jit = numba.njit(cache=True, fastmath=False, error_model="numpy")


@jit
def _up(message: Array, end: Array, sizes: Array, starts: Array, ends: Array) -> None:
    """Fill ``message`` of levels 2 to D + 1 with the mass that terminated at every level below."""
    for d in range(len(sizes)):
        c = sizes[d]
        for i in range((starts[d + 1] - starts[d]) // c):
            total = 0.0
            for j in range(c):
                total += message[starts[d] + i * c + j] * end[ends[d] + 2 * j + 1]
            message[starts[d + 1] + i] = total


@jit
def _down(
    message: Array, spread: Array, select: Array, end: Array, sizes: Array, starts: Array, ends: Array, selects: Array
) -> None:
    """Fill ``spread`` of levels D + 1 down to 1: what terminated, spread by the selections, and what was kept."""
    depth = len(sizes)
    spread[starts[depth]] = message[starts[depth]]
    for d in range(depth - 1, -1, -1):
        c = sizes[d]
        callers = sizes[d + 1] if d + 1 < depth else 1
        for i in range((starts[d + 1] - starts[d]) // c):
            mass = spread[starts[d + 1] + i]
            row = selects[d] + (i % callers) * c
            for j in range(c):
                here = starts[d] + i * c + j
                spread[here] = mass * select[row + j] + message[here] * end[ends[d] + 2 * j]


@jit
def _adjoint(
    message: Array,
    spread: Array,
    back: Array,
    select: Array,
    end: Array,
    to_select: Array,
    to_end: Array,
    scale: float,
    sizes: Array,
    starts: Array,
    ends: Array,
    selects: Array,
) -> None:
    """Adjoint of :func:`_up` and :func:`_down`. ``back`` holds, at level 1, the adjoint of ``spread``; it becomes that
    of ``message``. ``to_select`` and ``to_end`` receive posterior probabilities, ``scale`` being what normalises them.
    """
    depth = len(sizes)
    for d in range(depth):
        c = sizes[d]
        callers = sizes[d + 1] if d + 1 < depth else 1
        for i in range((starts[d + 1] - starts[d]) // c):
            mass = spread[starts[d + 1] + i] * scale
            row = selects[d] + (i % callers) * c
            total = 0.0
            for j in range(c):
                term = back[starts[d] + i * c + j] * select[row + j]
                total += term
                to_select[row + j] += mass * term
            back[starts[d + 1] + i] = total
    for d in range(depth - 1, -1, -1):
        c = sizes[d]
        for i in range((starts[d + 1] - starts[d]) // c):
            above = back[starts[d + 1] + i]
            for j in range(c):
                here = starts[d] + i * c + j
                keep = back[here] * end[ends[d] + 2 * j]
                stop = above * end[ends[d] + 2 * j + 1]
                to_end[ends[d] + 2 * j] += message[here] * keep * scale
                to_end[ends[d] + 2 * j + 1] += message[here] * stop * scale
                back[here] = keep + stop


@jit
def _arrive(
    t: int,
    alpha: Array,
    message: Array,
    spread: Array,
    select: Array,
    end: Array,
    sizes: Array,
    starts: Array,
    ends: Array,
    selects: Array,
) -> None:
    """Fill ``spread`` with what is expected at t, before its control is seen, given ``alpha`` at t - 1."""
    if t == 0:  # everything is selected: all mass has terminated, none is kept
        message[:] = 0.0
        message[starts[-1]] = 1.0
    else:
        message[: alpha.shape[1]] = alpha[t - 1]
        _up(message, end, sizes, starts, ends)
    _down(message, spread, select, end, sizes, starts, ends, selects)


@jit
def _forward(
    select: Array, end: Array, emission: Array, alpha: Array, sizes: Array, starts: Array, ends: Array, selects: Array
) -> float:
    """Fill ``alpha`` [T, S] with filtered probabilities; the log-likelihood, or NaN where a step has none left."""
    joint = starts[1] if len(sizes) else 1
    message, spread = np.zeros(starts[-1] + 1), np.zeros(starts[-1] + 1)
    value = 0.0
    for t in range(len(emission)):
        _arrive(t, alpha, message, spread, select[t], end[t], sizes, starts, ends, selects)
        total = 0.0
        for s in range(joint):
            alpha[t, s] = spread[s] * emission[t, s]
            total += alpha[t, s]
        if not total > 0.0:
            return np.nan
        alpha[t] /= total
        value += np.log(total)
    return value


@jit
def _backward(
    select: Array,
    end: Array,
    emission: Array,
    alpha: Array,
    to_select: Array,
    to_end: Array,
    to_emission: Array,
    sizes: Array,
    starts: Array,
    ends: Array,
    selects: Array,
) -> float:
    """Fill the posteriors; the smallest overlap Σ α_t β_t met on the way (α sums to 1, the largest β is 1)."""
    joint = starts[1] if len(sizes) else 1
    message, spread, back = np.zeros(starts[-1] + 1), np.zeros(starts[-1] + 1), np.zeros(starts[-1] + 1)
    beta = np.ones(joint)
    least = 1.0
    for t in range(len(emission) - 1, -1, -1):
        beta /= beta.max()
        overlap = 0.0
        for s in range(joint):
            to_emission[t, s] = alpha[t, s] * beta[s]
            overlap += to_emission[t, s]
        to_emission[t] /= overlap
        least = min(least, overlap)
        _arrive(t, alpha, message, spread, select[t], end[t], sizes, starts, ends, selects)
        total = 0.0
        for s in range(joint):
            back[s] = beta[s] * emission[t, s]
            total += spread[s] * back[s]
        _adjoint(
            message, spread, back, select[t], end[t], to_select[t], to_end[t], 1.0 / total, sizes, starts, ends, selects
        )
        beta[:] = back[:joint]
    return least


@numba.njit(cache=True, parallel=True, error_model="numpy")
def forward_backward(
    select: Array,
    end: Array,
    emission: Array,
    lengths: Array,
    sizes: Array,
    starts: Array,
    ends: Array,
    selects: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Log-likelihoods [N], the least overlap of each [N], and posteriors shaped like the tables.

    :param select: selection probabilities [N, T, Σ callers·C_d]; ``selects`` has each level's first column.
    :param end: termination probabilities [N, T, Σ 2·C_d]; ``ends`` has each level's first column.
    :param emission: exp of the emissions, scaled, [N, T, S].
    :param sizes: C_d, lowest level first; ``starts``: first index of each level's message, that of level D + 1 last.
    """
    value, overlap = np.zeros(len(lengths)), np.zeros(len(lengths))
    to_select, to_end, to_emission = np.zeros_like(select), np.zeros_like(end), np.zeros_like(emission)
    for n in numba.prange(len(lengths)):
        length = lengths[n]
        alpha = np.zeros((length, emission.shape[2]))
        value[n] = _forward(
            select[n, :length], end[n, :length], emission[n, :length], alpha, sizes, starts, ends, selects
        )
        if value[n] == value[n]:
            overlap[n] = _backward(
                select[n, :length], end[n, :length], emission[n, :length], alpha,
                to_select[n], to_end[n], to_emission[n], sizes, starts, ends, selects,
            )  # fmt: skip
    return value, overlap, to_select, to_end, to_emission
