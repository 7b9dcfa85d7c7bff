"""A user's encoder, ``module:Class``: imported, checked at each call, and tried before it is used."""

from __future__ import annotations

import sys
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np

from ddco_pyro.encoding.autoencoder import PictureNetwork
from ddco_pyro.errors import BadInput

TOLERANCE = 1e-3
"""Largest difference between two calls on the same picture, as a part of the largest feature."""


class UserEncoder(PictureNetwork):
    """``Class()`` of a user's ``module:Class``, of which the name alone is kept.

    :raises BadInput: the class cannot be imported or made; at a call, it fails or gives no features.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        try:
            own: Any = resolve_name(name)()
        except Exception as error:  # whatever the user's code raises
            raise BadInput(f"encoder {name!r} cannot be imported or made: {_message(error)}") from error
        if not callable(own):
            what = f"what {name.rpartition(':')[2]}() gives"
            raise BadInput(f"encoder {name!r}: {what} cannot be called; it needs __call__(pictures)")
        self._call = own.__call__  # its weights are none of this module's
        module = sys.modules.get(name.partition(":")[0])
        self.code = Path(module.__file__).read_bytes() if module is not None and module.__file__ else b""

    def encode(self, pictures: np.ndarray) -> np.ndarray:
        """Features of each picture, floats [N, F]."""
        try:
            values = np.asarray(self._call(pictures))
        except Exception as error:
            raise BadInput(f"encoder {self.name!r} fails on pictures {[*pictures.shape]}: {_message(error)}") from error
        problem = ""
        if values.dtype.kind != "f":
            problem = f"{values.dtype}; it has to give floats"
        elif values.ndim != 2 or len(values) != len(pictures) or not values.shape[1]:
            count = len(pictures)
            problem = f"shape {values.shape} for {count} pictures; it has to be ({count}, features)"
        elif not np.isfinite(values.astype(np.float32)).all():
            problem = "features that are NaN or infinite in float32"
        if problem:
            raise BadInput(f"encoder {self.name!r} gives {problem}")
        return values

    def try_out(self, pictures: np.ndarray) -> None:
        """Compare the features of pictures with those of a second call, and with those of a picture alone.

        :raises BadInput: they differ, or the encoder fails.
        """
        first = self.encode(pictures)
        allowed, other = TOLERANCE * np.abs(first).max(), f"encoder {self.name!r} gives other features"
        if not _close(first, self.encode(pictures), allowed):
            raise BadInput(f"{other} when it is called again; switch off dropout and noise")
        if not _close(first[:1], self.encode(pictures[:1]), allowed):
            raise BadInput(f"{other} of a picture among others than alone; switch to evaluation mode")


def _close(some: np.ndarray, other: np.ndarray, allowed: float) -> bool:
    return some.shape == other.shape and bool((np.abs(some - other) <= allowed).all())


def _message(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
