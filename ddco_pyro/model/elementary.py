"""Elementary functions of many float64 numbers at once, compiled to vector instructions.

A loop vectorises where it is a polynomial without branches, so each function works on a contiguous array in place.
"""

from __future__ import annotations

import math

import numba
import numpy as np

Array = np.ndarray

jit = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})

LOG2_E = math.log2(math.e)
LN2_HIGH, LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
SMALLEST = -708.0
"""exp of less is 0 here; as a float64 it would be a subnormal number."""
EXPONENT_BIAS = 1023
MANTISSA, ONE = (1 << 52) - 1, EXPONENT_BIAS << 52
BLOCK = 512
"""Numbers in a block of intermediate results: they stay in the first cache."""

CENTRE = 3.0
SCALED_ERFC = (
    -3.451497488052316e-11, 8.393734858669998e-10, 1.201971944036733e-09, -8.217595058699489e-09,
    -1.3906145791791663e-08, 4.106401366791042e-08, 1.0277997488280234e-07, -1.404765431542417e-07,
    -6.175617678993209e-07, 3.5576086684076704e-07, 3.4730241678415896e-06, -7.308281468783382e-07,
    -2.0100843094844752e-05, 4.949196649968336e-06, 0.0001250994355712812, -0.00010515971958448065,
    -0.0007798322884823084, 0.0018886903449991718, 0.0025293918180474668, -0.02377051491717134, 0.06830802734384515,
    -0.11927366341538638, 0.12964515870276475, -0.0475622943534492, -0.1356211061245812, 1.2530080582697296,
)  # fmt: skip
"""(1 + 2z) exp(z²) erfc(z) for z ≥ 0 as a polynomial in (z - 3)/(z + 3), highest power first, after Shepherd and
Laframboise (1981)."""

SQRT_HALF, SQRT_2_OVER_PI = math.sqrt(0.5), math.sqrt(2 / math.pi)


@jit
def exponentials(x: Array) -> None:
    """exp(x) in place of x [M]: relative error below 5e-16, 0 below :data:`SMALLEST`, NaN for NaN."""
    bits = np.empty(BLOCK, np.int64)
    scale, fraction = bits.view(np.float64), np.empty(BLOCK)
    for first in range(0, len(x), BLOCK):
        own = x[first : first + BLOCK]
        for i in range(len(own)):
            v = own[i]
            within = min(max(v, SMALLEST), 709.0)
            k = np.floor(within * LOG2_E + 0.5)
            r = v - k * LN2_HIGH - k * LN2_LOW
            q = 2.08767569878681e-09
            q = q * r + 2.505210838544172e-08
            q = q * r + 2.755731922398589e-07
            q = q * r + 2.7557319223985893e-06
            q = q * r + 2.48015873015873e-05
            q = q * r + 0.0001984126984126984
            q = q * r + 0.001388888888888889
            q = q * r + 0.008333333333333333
            q = q * r + 0.041666666666666664
            q = q * r + 0.16666666666666666
            q = q * r + 0.5
            q = q * r + 1.0
            fraction[i] = 0.0 if v < SMALLEST else q * r + 1.0
            bits[i] = np.int64(np.int32(k) + np.int32(EXPONENT_BIAS)) << 52
        for i in range(len(own)):
            own[i] = fraction[i] * scale[i]


@jit
def logarithms(x: Array) -> None:
    """log(x) in place of positive normal x [M]: error below 5e-16, relative or absolute; NaN for NaN."""
    bits, exponent = np.empty(BLOCK, np.int64), np.empty(BLOCK)
    mantissa = bits.view(np.float64)
    for first in range(0, len(x), BLOCK):
        own = x[first : first + BLOCK]
        seen = own.view(np.int64)
        for i in range(len(own)):
            exponent[i] = np.float64(np.int32(seen[i] >> 52) - np.int32(EXPONENT_BIAS))
            bits[i] = (seen[i] & MANTISSA) | ONE
        for i in range(len(own)):
            high = mantissa[i] > 1.4142135623730951
            m = 0.5 * mantissa[i] if high else mantissa[i]
            k = exponent[i] + 1.0 if high else exponent[i]
            s = (m - 1.0) / (m + 1.0)
            z = s * s
            q = 1.0 / 21.0
            q = q * z + 1.0 / 19.0
            q = q * z + 1.0 / 17.0
            q = q * z + 1.0 / 15.0
            q = q * z + 1.0 / 13.0
            q = q * z + 1.0 / 11.0
            q = q * z + 1.0 / 9.0
            q = q * z + 1.0 / 7.0
            q = q * z + 1.0 / 5.0
            q = q * z + 1.0 / 3.0
            value = k * LN2_HIGH + (2.0 * s + (2.0 * s * z * q + k * LN2_LOW))
            own[i] = value if own[i] == own[i] else np.nan


@jit
def log_normal_cdf(x: Array, slope: Array) -> None:
    """log Φ(x) in place of x [M], and its derivative φ(x) / Φ(x) as ``slope`` [M].

    log Φ has an error of at most 2e-15, relative or absolute; the derivative has a relative one of at most 4e-15.
    """
    block_of_t, block_of_ratio, block_of_square = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for first in range(0, len(x), BLOCK):
        own, density = x[first : first + BLOCK], slope[first : first + BLOCK]
        t, ratio, square = block_of_t[: len(own)], block_of_ratio[: len(own)], block_of_square[: len(own)]
        for i in range(len(own)):
            z = abs(own[i]) * SQRT_HALF
            t[i] = (z - CENTRE) / (z + CENTRE)
            ratio[i] = 0.0
            square[i] = density[i] = -0.5 * own[i] * own[i]
        for coefficient in SCALED_ERFC:
            for i in range(len(own)):
                ratio[i] = ratio[i] * t[i] + coefficient
        exponentials(density)
        for i in range(len(own)):
            low = own[i] <= 0.0
            scaled = ratio[i] / (1.0 + 2.0 * SQRT_HALF * abs(own[i]))  # exp(z²) erfc(z)
            below = 0.5 * scaled  # Φ(x) / exp(-x²/2) of a negative x
            whole = 1.0 - density[i] * below  # Φ(x) of a positive x
            part = below if low else whole
            density[i] = 0.5 * SQRT_2_OVER_PI * (1.0 if low else density[i]) / part
            square[i] = square[i] if low else 0.0
            own[i] = part
        logarithms(own)
        for i in range(len(own)):
            own[i] += square[i]
