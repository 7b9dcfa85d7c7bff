"""From what networks say to rows of numbers that exp() makes probabilities, and from posteriors back to gradients.

Softmax for selections, the bounded logistic for terminations, the Gaussian for controls: torch's own functions over
tables with a handful of columns take longer than the inference itself, so what is not elementwise is compiled here.
All rows are float64 [N, T, columns]; a level's columns begin at ``first``, and
:class:`ddco_pyro.inference.structure.Structure` has the layout.
"""

from __future__ import annotations

import numba
import numpy as np

Array = np.ndarray

jit = numba.njit(cache=True, parallel=True, error_model="numpy")


@jit
def shifted_logits(logits: Array, first: int, choices: int, rows: Array) -> None:
    """Logits [N, T, K, L] minus each caller's largest; where L < ``choices``, choice 0 is -inf."""
    number, steps, callers, size = logits.shape
    for n in numba.prange(number):
        for t in range(steps):
            for caller in range(callers):
                begin = first + caller * choices + choices - size
                top = logits[n, t, caller, 0]
                for j in range(1, size):
                    top = max(top, logits[n, t, caller, j])
                if size < choices:
                    rows[n, t, begin - 1] = -np.inf
                for j in range(size):
                    rows[n, t, begin + j] = np.float64(logits[n, t, caller, j]) - top


@jit
def normalised(callers: int, first: int, choices: int, rows: Array) -> None:
    """Divide the choices of each caller by their sum."""
    for n in numba.prange(rows.shape[0]):
        for t in range(rows.shape[1]):
            for begin in range(first, first + callers * choices, choices):
                total = 0.0
                for j in range(choices):
                    total += rows[n, t, begin + j]
                inverse = 1.0 / total
                for j in range(choices):
                    rows[n, t, begin + j] *= inverse


@jit
def log_gaussian(actions: Array, mean: Array, precision: Array, constant: float, first: int, rows: Array) -> None:
    """``constant`` - Σ_a (a - μ)² / 2σ² for means [N, T, K, A]; ``precision`` [A] is 1/σ²."""
    number, steps, callers, size = mean.shape
    for n in numba.prange(number):
        for t in range(steps):
            for j in range(callers):
                total = 0.0
                for a in range(size):
                    error = np.float64(actions[n, t, a]) - mean[n, t, j, a]
                    total += error * error * precision[a]
                rows[n, t, first + j] = constant - 0.5 * total


@jit
def shifted_densities(rows: Array, lengths: Array, shift: Array) -> None:
    """Subtract the largest log-density from each step's; what was subtracted, in sum over the steps, [N]."""
    for n in numba.prange(rows.shape[0]):
        shift[n] = 0.0
        for t in range(rows.shape[1]):
            top = rows[n, t, 0]
            for j in range(1, rows.shape[2]):
                top = max(top, rows[n, t, j])
            for j in range(rows.shape[2]):
                rows[n, t, j] -= top
            if t < lengths[n]:
                shift[n] += top


@jit
def logits_gradient(rows: Array, posterior: Array, upstream: Array, first: int, choices: int, gradient: Array) -> None:
    """Gradient [N, T, K, L] of logits: v_j - η_j Σ v, v the posterior of the selections."""
    number, steps, callers, size = gradient.shape
    for n in numba.prange(number):
        for t in range(steps):
            for caller in range(callers):
                begin = first + caller * choices + choices - size
                total = 0.0
                for j in range(size):
                    total += posterior[n, t, begin + j]
                for j in range(size):
                    own = posterior[n, t, begin + j] - rows[n, t, begin + j] * total
                    gradient[n, t, caller, j] = upstream[n] * own


@jit
def ending_gradient(rows: Array, posterior: Array, upstream: Array, first: int, gradient: Array) -> None:
    """Gradient [N, T, k] of the logits of ψ: ψ̂ (1 - ψ) - (1 - ψ̂) ψ, ψ̂ the posterior."""
    number, steps, options = gradient.shape
    for n in numba.prange(number):
        for t in range(steps):
            for j in range(options):
                column = first + 2 * j
                own = posterior[n, t, column + 1] * rows[n, t, column]
                gradient[n, t, j] = upstream[n] * (own - posterior[n, t, column] * rows[n, t, column + 1])


@jit
def gaussian_gradient(
    actions: Array, mean: Array, precision: Array, posterior: Array, upstream: Array, first: int, gradient: Array,
    spread: Array,
) -> None:  # fmt: skip
    """Gradient of the means, and of log σ for each trajectory, ``spread`` [N, A]."""
    number, steps, callers, size = mean.shape
    for n in numba.prange(number):
        for a in range(size):
            spread[n, a] = 0.0
        for t in range(steps):
            for j in range(callers):
                weight = upstream[n] * posterior[n, t, first + j]
                for a in range(size):
                    error = np.float64(actions[n, t, a]) - mean[n, t, j, a]
                    pull = weight * error * precision[a]
                    gradient[n, t, j, a] = pull
                    spread[n, a] += pull * error - weight
