"""Large files of demonstrations: what is claimed, what is stored, and how much memory a command takes with them."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

COMMAND = Path(sys.executable).with_name("ddco-pyro")


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


def measured(*arguments: object, **environment: str) -> Ended:
    """Run a command in a process of its own."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        process = subprocess.Popen(
            [COMMAND, *map(str, arguments)], stdout=out, stderr=err, env={**os.environ, **environment}
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0), err.seek(0)
        return Ended(process.returncode, out.read(), err.read(), 1024 * usage.ru_maxrss)
