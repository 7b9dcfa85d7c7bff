"""Paths of choices, compiled: a forward pass in log space, then one step back after the other; O(D·S) a step.

The pass either maximises over what came before or sums over it; going back then either takes the best way or draws one.
:class:`ddco_pyro.inference.structure.Structure` says what the index arrays mean, and
:mod:`ddco_pyro.inference.kernel` what messages and spread are; here both hold logarithms.
"""

from __future__ import annotations

import numba
import numpy as np

from ddco_pyro.inference.kernel import Array, Choices

jit = numba.njit(cache=True, forceinline=True, error_model="numpy")


@jit
def _plus(first: float, second: float, best: bool) -> float:
    """The larger of two logarithms, or the logarithm of their sum."""
    larger, smaller = (first, second) if first >= second else (second, first)
    return larger if best or smaller == -np.inf else larger + np.log1p(np.exp(smaller - larger))


@jit
def _caller(d: int, above: int, sizes: Choices, starts: Choices) -> int:
    """The row of selections that the caller at message index ``above`` of level d + 1 has; -1 below a choice 0."""
    return (above - starts[d + 1]) % sizes[d + 1] - 1 if d + 1 < len(sizes) else 0


@jit
def _selected(
    n: int, t: int, d: int, below: int, spread: Array, select: Array, sizes: Choices, starts: Choices, selects: Choices
) -> float:
    """Having selected, at level d, the choice of message index ``below``."""
    c = sizes[d]
    j = (below - starts[d]) % c
    above = starts[d + 1] + (below - starts[d]) // c
    caller = _caller(d, above, sizes, starts)
    if caller < 0:
        return spread[t, above] if j == 0 else -np.inf
    return spread[t, above] + select[n, t, selects[d] + caller * c + j]


@jit
def _kept(
    n: int, t: int, d: int, below: int, messages: Array, end: Array, sizes: Choices, starts: Choices, ends: Choices
) -> float:
    """Having kept, at level d, the choice of message index ``below``; choice 0 never is."""
    j = (below - starts[d]) % sizes[d]
    return messages[t, below] + end[n, t, ends[d] + 2 * j - 2] if j > 0 else -np.inf


@jit
def _ended(
    n: int, t: int, d: int, below: int, messages: Array, end: Array, sizes: Choices, starts: Choices, ends: Choices
) -> float:
    """Having terminated, at level d, the choice of message index ``below``; choice 0 always is."""
    j = (below - starts[d]) % sizes[d]
    return messages[t, below] + (end[n, t, ends[d] + 2 * j - 1] if j > 0 else 0.0)


@jit
def _forward(
    n: int, select: Array, end: Array, emission: Array, weight: Array, best: bool, messages: Array, spread: Array,
    sizes: Choices, starts: Choices, selects: Choices, ends: Choices, actors: Array,
) -> None:  # fmt: skip
    """Fill ``messages`` [1 + T, messages] and ``spread`` [T, messages] of trajectory n."""
    depth = len(sizes)
    messages[0] = -np.inf
    messages[0, starts[depth]] = 0.0  # at t = 0 everything is selected
    for t in range(len(spread)):
        for d in range(depth if t > 0 else 0):
            messages[t, starts[d + 1] : starts[d + 1] + (starts[d + 1] - starts[d]) // sizes[d]] = -np.inf
            for below in range(starts[d], starts[d + 1]):
                above = starts[d + 1] + (below - starts[d]) // sizes[d]
                ended = _ended(n, t, d, below, messages, end, sizes, starts, ends)
                messages[t, above] = _plus(messages[t, above], ended, best)
        spread[t, starts[depth]] = messages[t, starts[depth]]
        for d in range(depth - 1, -1, -1):
            for below in range(starts[d], starts[d + 1]):
                selected = _selected(n, t, d, below, spread, select, sizes, starts, selects)
                kept = _kept(n, t, d, below, messages, end, sizes, starts, ends)
                spread[t, below] = _plus(kept, selected, best)
        for s in range(len(actors)):
            messages[t + 1, s] = spread[t, s] + emission[n, t, actors[s]] if actors[s] >= 0 else -np.inf
            if weight.shape[2]:
                messages[t + 1, s] += weight[n, t, s]


@jit
def _pick(values: Array, best: bool, uniform: float) -> int:
    """The first of the largest logarithms, or a draw in proportion to what they are logarithms of."""
    largest = 0
    for i in range(len(values)):
        if values[i] > values[largest]:
            largest = i
    if best:
        return largest
    total = 0.0
    for i in range(len(values)):
        total += np.exp(values[i] - values[largest])
    left = uniform * total
    for i in range(len(values)):
        left -= np.exp(values[i] - values[largest])
        if left < 0.0:
            return i
    return largest  # rounding left a little


@jit
def _before(
    n: int, t: int, d: int, index: int, messages: Array, end: Array, best: bool, uniforms: Array, sizes: Choices,
    starts: Choices, ends: Choices,
) -> int:  # fmt: skip
    """The joint choice at t - 1, of which level d + 1's message has ``index``, with all levels up to d terminated."""
    for level in range(d, -1, -1):
        c = sizes[level]
        first = starts[level] + (index - starts[level + 1]) * c
        ways = np.empty(c)
        for j in range(c):
            ways[j] = _ended(n, t, level, first + j, messages, end, sizes, starts, ends)
        index = first + _pick(ways, best, uniforms[len(sizes) + level])
    return index


@jit
def _back(
    n: int, select: Array, end: Array, messages: Array, spread: Array, best: bool, uniforms: Array, joint: Array,
    terminated: Array, sizes: Choices, starts: Choices, selects: Choices, ends: Choices,
) -> bool:  # fmt: skip
    """Fill ``joint`` [T] and the number of levels that ``terminated`` [T], from the last step to the first; whether the
    path has a probability above 0.
    """
    depth, steps = len(sizes), len(joint)
    index = _pick(messages[steps, : starts[1]], best, uniforms[steps, 0])
    possible = messages[steps, index] > -np.inf
    for t in range(steps - 1, -1, -1):
        joint[t] = index
        d = 0
        while d < depth:
            kept = _kept(n, t, d, index, messages, end, sizes, starts, ends) if t > 0 else -np.inf
            selected = _selected(n, t, d, index, spread, select, sizes, starts, selects)
            if _pick(np.array([kept, selected]), best, uniforms[t, d]) == 0 and kept > -np.inf:
                break
            index = starts[d + 1] + (index - starts[d]) // sizes[d]
            d += 1
        terminated[t] = d
        if t > 0:
            index = _before(n, t, d - 1, index, messages, end, best, uniforms[t], sizes, starts, ends)
    return bool(possible)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def trace(
    select: Array, end: Array, emission: Array, weight: Array, lengths: Array, best: bool, uniforms: Array,
    joint: Array, terminated: Array, possible: Array, sizes: Choices, starts: Choices, selects: Choices, ends: Choices,
    actors: Array,
) -> None:  # fmt: skip
    """Fill the ``joint`` choices [M, N, T] of M paths, and how many levels ``terminated`` there, -1 past the lengths.

    ``possible`` [N] says which trajectories have a probability above 0; the paths of others mean nothing.

    :param select: log-probabilities [N, T, Σ callers·C_d]; ``end`` [N, T, Σ 2·k_d]; ``emission`` [N, T, 1 + Σ k_d].
    :param weight: logarithms of factors of the joint choices [N, T, S], or [N, T, 0] where there are none.
    :param best: the most likely path, rather than one drawn by its posterior probability.
    :param uniforms: numbers uniform in [0, 1), [M, N, 1 + T, 2·D].
    """
    joint[:], terminated[:] = -1, -1
    for n in numba.prange(len(lengths)):
        messages = np.empty((1 + lengths[n], starts[-1] + 1))
        spread = np.empty((lengths[n], starts[-1] + 1))
        _forward(
            n, select, end, emission, weight, best, messages, spread, sizes, starts, selects, ends, actors
        )  # fmt: skip
        for m in range(len(joint)):
            possible[n] = _back(
                n, select, end, messages, spread, best, uniforms[m, n], joint[m, n, : lengths[n]],
                terminated[m, n, : lengths[n]], sizes, starts, selects, ends,
            )  # fmt: skip
