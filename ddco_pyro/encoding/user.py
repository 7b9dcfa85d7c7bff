"""A user's encoder, ``module:Class``: imported, checked at each call, and tried before it is used."""

from __future__ import annotations

from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

import numpy as np

from ddco_pyro.errors import BadInput

Features = Callable[[np.ndarray], np.ndarray]
"""uint8 pictures [N, H, W, C] to features [N, F]."""

TOLERANCE = 1e-3
"""Largest difference between two calls on the same picture, as a part of the largest feature."""


def imported(name: str) -> Features:
    """``Class()`` of a user's ``module:Class``, whose features are checked at each call.

    :raises BadInput: the class cannot be imported or made; at a call, it fails or gives no features.
    """
    try:
        own: Any = resolve_name(name)()
    except Exception as error:  # whatever the user's code raises
        raise BadInput(f"encoder {name!r} cannot be imported or made: {_message(error)}") from error
    if not callable(own):
        raise BadInput(
            f"encoder {name!r}: what {name.rpartition(':')[2]}() gives cannot be called; it needs __call__(pictures)"
        )

    def features(pictures: np.ndarray) -> np.ndarray:
        try:
            values = np.asarray(own(pictures))
        except Exception as error:
            raise BadInput(f"encoder {name!r} fails on pictures {[*pictures.shape]}: {_message(error)}") from error
        _check(name, values, len(pictures))
        return values

    return features


def _check(name: str, values: np.ndarray, number: int) -> None:
    if values.dtype.kind != "f":
        raise BadInput(f"encoder {name!r} gives {values.dtype}; it has to give floats")
    if values.ndim != 2 or len(values) != number or not values.shape[1]:
        raise BadInput(
            f"encoder {name!r} gives shape {values.shape} for {number} pictures; it has to be ({number}, features)"
        )
    if not np.isfinite(values.astype(np.float32)).all():
        raise BadInput(f"encoder {name!r} gives features that are NaN or infinite in float32")


def try_out(name: str, features: Features, pictures: np.ndarray) -> None:
    """Compare the features of pictures with those of a second call, and with those of a picture alone.

    :raises BadInput: they differ, or the encoder fails.
    """
    first = features(pictures)
    allowed = TOLERANCE * np.abs(first).max()
    if not _close(first, features(pictures), allowed):
        raise BadInput(f"encoder {name!r} gives other features when it is called again; switch off dropout and noise")
    if not _close(first[:1], features(pictures[:1]), allowed):
        raise BadInput(
            f"encoder {name!r} gives other features of a picture among others than alone; switch to evaluation mode"
        )


def _close(some: np.ndarray, other: np.ndarray, allowed: float) -> bool:
    return some.shape == other.shape and bool((np.abs(some - other) <= allowed).all())


def _message(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
