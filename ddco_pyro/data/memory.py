"""Memory: the bytes that may be used, against the size of arrays as their headers give it.

Free memory decides what is refused, and no number of a result: chunks are cut for a fixed size, see :func:`share`.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.errors import BadInput

VARIABLE = "DDCO_PYRO_MEMORY"
UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}

PROGRAM = 680e6
"""Bytes of a fit to next to nothing: mostly torch, Pyro and compiled code."""

COPIES = 4.0 + 16.0
"""Bytes per number beyond the array as read: float32 in a padded batch, and two temporary float64 copies."""

INFERENCE = 5e3
"""Bytes of inference per step of trajectories that are processed together."""


class Array(Protocol):
    """An array, in memory or in a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """[T, ...]."""

    @property
    def dtype(self) -> np.dtype:
        """The type of its numbers."""


def needed(demonstrations: Iterable[Mapping[str, Array]], copies: float = COPIES) -> float:
    """Bytes for demonstrations, by their headers: the arrays as read, and copies padded to the longest demonstration.

    Pictures that stay in their file count for nothing.

    :param demonstrations: arrays by place (``actions``, ``obs/<key>``, ``labels/<name>``).
    :param copies: bytes of a number beyond the array as read.
    """
    number, longest, size, features = 0, 0, 0, 0
    for arrays in demonstrations:
        number, numbers = number + 1, 0
        longest = max(longest, *arrays["actions"].shape[:1], 0)
        for place, array in arrays.items():
            plain = array.dtype == np.uint8
            if getattr(array, "kept", None) is None:
                size += math.prod(array.shape) * (1 if plain else 8)
            if not place.startswith("labels/") and not (plain and len(array.shape) == 4):
                numbers += math.prod(array.shape[1:])
        features = max(features, numbers)
    return PROGRAM + size + copies * features * number * longest


SMALL = 1e6
"""Bytes that are taken without asking how many are free."""


def allowed() -> float:
    """Bytes that may be used: ``$DDCO_PYRO_MEMORY`` if set, else the free memory.

    :raises BadInput: ``$DDCO_PYRO_MEMORY`` is not a positive number with an optional unit.
    """
    return _configured() or _free()


def _free(root: Path = Path("/")) -> float:
    """Free bytes of the machine, at most the limits of this process's control groups.

    :param root: the folder that holds ``proc`` and ``sys``.
    """
    found = [float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))]
    try:
        available = re.search(r"^MemAvailable:\s+(\d+) kB$", (root / "proc/meminfo").read_text(), re.MULTILINE)
        found += [float(available[1]) * 1024] if available else []
        group, top = (root / "proc/self/cgroup").read_text().strip().rpartition("::")[2], root / "sys/fs/cgroup"
        own = top / group.strip("/")
        limits = [part / "memory.max" for part in (own, *own.parents) if part.is_relative_to(top)]
        found += [float(file.read_text()) for file in limits if file.exists() and file.read_text() != "max\n"]
    except (OSError, ValueError):
        pass  # not Linux
    return min(found)


def _configured() -> float | None:
    text = os.environ.get(VARIABLE)
    if text is None:
        return None
    parsed = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([KMGT]?B)?\s*", text, re.IGNORECASE)
    number = float(parsed[1]) * UNITS[(parsed[2] or "GB").upper()] if parsed else 0.0
    if not number > 0:
        raise BadInput(f"{VARIABLE}={text}: has to be a number of GB, or one with a unit, such as 2GB or 500MB")
    return number


def share() -> float:
    """Bytes for the networks' activations: a fixed part of ``$DDCO_PYRO_MEMORY`` or 2 GB, beyond the program.

    The size of chunks affects the last digits of results, so free memory does not enter.
    """
    return max(1.0, ((_configured() or 2e9) - PROGRAM - 100e6) / 4.75)  # the rest: files, clusters, inference


def refuse_too_much(needed: float, what: str, remedy: str) -> None:
    """Refuse work that needs more memory than is allowed.

    :param what: subject of the error's sentence.
    :raises DemonstrationsError: ``needed`` bytes are more than :func:`allowed`.
    """
    if needed < SMALL and not _configured():
        return
    if needed > allowed():
        more = math.ceil(needed / 1e8) / 10
        raise DemonstrationsError(
            f"{what} takes about {more:g} GB of memory, and {allowed() / 1e9:.4g} are allowed; {remedy}, "
            f"or allow more with {VARIABLE}={more:g}GB"
        )
