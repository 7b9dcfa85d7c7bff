"""The command line in a forked child, within limits of time and memory: no import is paid again."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import time
from pathlib import Path
from typing import NamedTuple

import command_line

SECONDS = 10
ADDRESSES = 8 * 10**9
"""Bytes of address space beyond what the parent has: a command that reads without end fails in the child."""


class Ended(NamedTuple):
    """How a command ended.

    :param status: negative where a signal ended it; ``-SIGALRM`` after :data:`SECONDS`.
    :param grown: bytes of memory that it had at most beyond those of the parent.
    """

    status: int
    out: str
    err: str
    seconds: float
    grown: int


def call(*arguments: object) -> Ended:
    """Run a command in a copy of this process."""
    began = time.monotonic()
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        _child(writer, arguments)
    os.close(writer)
    with open(reader, "rb") as pipe:
        told = pipe.read()
    _, ended = os.waitpid(child, 0)
    status, out, err, grown = pickle.loads(told) if told else (os.waitstatus_to_exitcode(ended), "", "", 0)
    return Ended(status, out, err, time.monotonic() - began, grown)


def _child(writer: int, arguments: tuple[object, ...]) -> None:
    """Call the command, tell how it ended, and end this process without any cleaning up of the parent's."""
    try:
        pages, resident = map(int, Path("/proc/self/statm").read_text().split()[:2])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ADDRESSES,) * 2)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(SECONDS)
        ended = command_line.call(*arguments)
        most = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with open(writer, "wb") as pipe:
            pipe.write(pickle.dumps((*ended, most - resident * resource.getpagesize())))
    finally:
        os._exit(1)
