"""Which numbers of a file can be used, and which say something."""

from __future__ import annotations

from typing import Any

import numpy as np

NUMBERS = "fiub"
"""Kinds of numpy types that are real numbers."""

LARGEST = 1e30
"""No number may be larger: networks are float32, which ends at 3e38, and variances are float64, which ends at 1e308."""


def usable(values: np.ndarray) -> np.ndarray:
    """Whether each of these real numbers is finite and at most :data:`LARGEST` in size."""
    if values.dtype.kind != "f":
        return np.ones(values.shape, dtype=bool)
    return np.abs(values) <= min(LARGEST, float(np.finfo(values.dtype).max))  # NaN is not


RESOLUTION = 1e-9
"""A dimension rests where its range is this part of its largest value; of coarser types, :data:`LAST_PLACES` units in
the last place."""

LAST_PLACES = 4

SETTLED = 256 * float(np.finfo(np.float32).eps)
"""A dimension rests where its range is this part, 3e-5, of the largest value of all dimensions of its observation, 1 at
most. Components of a vector are rounded alike, whatever their own size: those of a quaternion at rest lie 6e-7 to
1.6e-5 apart in Meta-World's files, once a simulator has rounded them in every step. Of dimensions in mixed units one
may have thousands, which says nothing of the others: hence 1 at most."""


def rounding(low: np.ndarray, high: np.ndarray, dtype: np.dtype[Any]) -> np.ndarray:
    """The largest range of each dimension of an observation that is rounding alone, [D]: below it the dimension rests.

    :param low: the smallest value of each dimension [D], and ``high`` the largest; NaN comes of what is not finite.
    :param dtype: the type of the values in the file; whole numbers are not rounded.
    """
    sizes = np.maximum(np.abs(np.asarray(low, np.float64)), np.abs(np.asarray(high, np.float64)))
    finite = np.isfinite(sizes)
    if dtype.kind != "f":
        return np.where(finite, 0.0, np.nan)
    own = max(RESOLUTION, LAST_PLACES * float(np.finfo(dtype).eps)) * np.maximum(sizes, RESOLUTION)
    largest = min(1.0, float(sizes.max(initial=0.0, where=finite)))
    return np.where(finite, np.maximum(own, SETTLED * largest), np.nan)
