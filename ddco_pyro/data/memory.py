"""Memory: what is free, against the size of arrays as their headers give it. No number of a result depends on it."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError

PROGRAM = 680e6
"""Bytes of a fit to next to nothing: mostly torch, Pyro and compiled code."""

COPIES = 4.0 + 16.0
"""Bytes per number beyond the array as read: float32 in a padded batch, and two temporary float64 copies."""

INFERENCE = 5e3
"""Bytes of inference per step of trajectories that are processed together."""

SMALL = 1e6
"""Bytes that are taken without asking how many are free."""


def needed(demonstrations: Iterable[Mapping[str, Any]], copies: float = COPIES) -> float:
    """Bytes for demonstrations, by their headers: the arrays as read, and copies padded to the longest demonstration.

    Pictures that stay in their file count for nothing.

    :param demonstrations: arrays [T, ...] or columns by place (``actions``, ``obs/<key>``, ``labels/<name>``).
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


def free(root: Path = Path("/")) -> float:
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


def refuse_too_much(needed: float, what: str, remedy: str) -> None:
    """Refuse work that needs more memory than is :func:`free`.

    :param what: subject of the error's sentence.
    :raises DemonstrationsError: it does.
    """
    if needed >= SMALL and needed > (there := free()):
        size = math.ceil(needed / 1e8) / 10
        raise DemonstrationsError(f"{what} takes about {size:g} GB of memory, and {there / 1e9:.4g} are free; {remedy}")
