"""Forward-backward of :mod:`ddco_pyro.inference.kernel` for one level, the common case: nothing goes up or comes down.

Here ``messages`` [1 + T, C + 1] hold in row t what is known of the choice at t - 1, before it is normalised, so that a
step need not wait for the division; their last column is the mass that terminated at t.
"""

from __future__ import annotations

import numba
import numpy as np

from ddco_pyro.inference.kernel import TOLERANCE, Array

jit = numba.njit(cache=True, error_model="numpy")


@jit
def _likelihood(emission: Array, weight: Array) -> Array:
    """What each choice makes of a step's control, [T, C]: the meta-policy acts where the choice is 0."""
    steps, c = emission.shape
    likelihood = np.empty((steps, c))
    for t in range(steps):
        likelihood[t, 0] = emission[t, c - 1]
        for j in range(1, c):
            likelihood[t, j] = emission[t, j - 1]
        if weight.shape[1]:
            for j in range(c):
                likelihood[t, j] *= weight[t, j]
    return likelihood


@jit
def _forward(select: Array, end: Array, likelihood: Array, messages: Array, scale: Array) -> float:
    """Fill ``messages`` and ``scale`` [T]; the log-likelihood, NaN where a step leaves no mass."""
    steps, c = likelihood.shape
    messages[0] = 0.0
    messages[0, 0] = 1.0  # at t = 0 everything is selected
    value, before = 0.0, 1.0
    for t in range(steps):
        mass = messages[t, 0]
        for j in range(1, c):
            mass += messages[t, j] * end[t, 2 * j - 1]
        mass *= before
        messages[t, c] = mass
        total = mass * select[t, 0] * likelihood[t, 0]
        messages[t + 1, 0] = total
        for j in range(1, c):
            kept = messages[t, j] * before * end[t, 2 * j - 2]
            message = (mass * select[t, j] + kept) * likelihood[t, j]
            messages[t + 1, j] = message
            total += message
        value += np.log(total) if total > 0.0 else np.nan
        before = 1.0 / total
        scale[t] = before
    return value


@jit
def _backward(
    select: Array, end: Array, likelihood: Array, messages: Array, scale: Array, to_select: Array, to_end: Array,
    to_emission: Array, to_choice: Array,
) -> bool:  # fmt: skip
    """Fill the posteriors; whether Σ_h α_t(h) β_t(h) = 1 at every step: so it is but for what underflow has lost."""
    steps, c = likelihood.shape
    back, exact = np.ones(c), True
    for t in range(steps - 1, -1, -1):
        mass, total, over = messages[t, c], 0.0, 0.0
        for j in range(c):
            seen = back[j] * scale[t]
            both = messages[t + 1, j] * seen
            total += both
            to_emission[t, j - 1 if j else c - 1] = both
            if to_choice.shape[1]:
                to_choice[t, j] = both
            back[j] = seen * likelihood[t, j]
            term = back[j] * select[t, j]
            over += term
            to_select[t, j] = mass * term
        exact &= abs(total - 1.0) <= TOLERANCE and np.isfinite(over)  # NaN is not
        if t == 0:
            to_end[0] = 0.0
            break
        back[0] = over
        for j in range(1, c):
            known = messages[t, j] * scale[t - 1]
            keeping, stopping = back[j] * end[t, 2 * j - 2], over * end[t, 2 * j - 1]
            to_end[t, 2 * j - 2] = known * keeping
            to_end[t, 2 * j - 1] = known * stopping
            back[j] = keeping + stopping
    return exact


@numba.njit(cache=True, parallel=True, error_model="numpy")
def forward_backward(
    select: Array, end: Array, emission: Array, weight: Array, lengths: Array, value: Array, exact: Array,
    to_select: Array, to_end: Array, to_emission: Array, to_choice: Array,
) -> None:  # fmt: skip
    """:func:`ddco_pyro.inference.kernel.forward_backward` for one level."""
    for n in numba.prange(len(lengths)):
        steps = lengths[n]
        messages, scale = np.empty((1 + steps, select.shape[2] + 1)), np.empty(steps)
        likelihood = _likelihood(emission[n, :steps], weight[n, :steps])
        value[n] = _forward(select[n], end[n], likelihood, messages, scale)
        exact[n] = _backward(
            select[n], end[n], likelihood, messages, scale, to_select[n], to_end[n], to_emission[n], to_choice[n]
        )
        to_select[n, steps:] = 0.0
        to_end[n, steps:] = 0.0
        to_emission[n, steps:] = 0.0
        to_choice[n, steps:] = 0.0
