"""Memory: what is free, against the size of arrays as their headers give it. No number of a result depends on it."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

from ddco_pyro.data.errors import DemonstrationsError

PROGRAM = 680e6
"""Bytes of a fit to next to nothing: mostly torch, Pyro and compiled code."""

INFERENCE = 5e3
"""Bytes of inference per step of trajectories that are processed together."""

SMALL = 1e6
"""Bytes that are taken without asking how many are free."""


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
