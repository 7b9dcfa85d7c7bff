"""Large files of demonstrations: what is claimed, what is stored, and how much memory a command takes with them."""

from __future__ import annotations

import os
import subprocess
import sys
import zlib
from typing import NamedTuple

import h5py
import numpy as np
from command_line import COMMAND


def zeros(group: h5py.Group, place: str, shape: tuple[int, ...], chunk: tuple[int, ...], dtype: str = "f8") -> None:
    """An array of zeros that is really there: every chunk of it is stored, compressed to a thousandth."""
    dataset = group.create_dataset(place, shape, dtype, chunks=chunk, maxshape=(None, *shape[1:]), compression="gzip")
    stored = zlib.compress(bytes(int(np.prod(chunk)) * dataset.dtype.itemsize), 1)
    for start in np.ndindex(*(-(-size // part) for size, part in zip(shape, chunk, strict=True))):
        dataset.id.write_direct_chunk(tuple(np.multiply(start, chunk)), stored)


class Ended(NamedTuple):
    """How a command ended, and the most memory it had, bytes."""

    status: int
    out: str
    err: str
    peak: int


SMALL = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:]).returncode
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(status)
"""
"""A process counts the memory of the one that started it: this one has little."""


def measured(*arguments: object, **environment: str) -> Ended:
    command = [sys.executable, "-c", SMALL, COMMAND, *map(str, arguments)]
    ended = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    out, _, peak = ended.stdout.rstrip().rpartition("\n")
    return Ended(ended.returncode, out, ended.stderr, 1024 * int(peak))
