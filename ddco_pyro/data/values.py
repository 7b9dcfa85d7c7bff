"""Which numbers of a file can be used."""

from __future__ import annotations

import numpy as np

NUMBERS = "fiub"
"""Kinds of numpy types that are real numbers."""

LARGEST = 1e30
"""No number may be larger: networks are float32, which ends at 3e38, and variances are float64, which ends at 1e308."""


def usable(values: np.ndarray) -> np.ndarray:
    """Whether each of these real numbers is finite and at most :data:`LARGEST` in size."""
    if values.dtype.kind != "f":
        return np.ones(values.shape, dtype=bool)
    return np.abs(values) <= LARGEST  # NaN is not
