"""The command line in a forked child, within limits of time and memory: no import is paid again."""

from __future__ import annotations

import os
import pickle
import resource
import signal
from pathlib import Path
from typing import NamedTuple

import command_line

SECONDS = 10
"""Of computing; one that waits, for a pipe, ends after six times as long, however busy the machine is."""

ADDRESSES = 8 * 10**9
"""Bytes of address space beyond what the parent has: a command that reads without end fails in the child."""


class Ended(NamedTuple):
    """How a command ended.

    :param status: negative where a signal ended it: SIGXCPU after :data:`SECONDS`, SIGALRM where it hangs.
    :param seconds: of computing.
    :param grown: bytes of memory that it had at most beyond those of the parent.
    """

    status: int
    out: str
    err: str
    seconds: float
    grown: int


def call(*arguments: object) -> Ended:
    """Run a command in a copy of this process."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        _child(writer, arguments)
    os.close(writer)
    with open(reader, "rb") as pipe:
        told = pipe.read()
    _, ended = os.waitpid(child, 0)
    return Ended(*pickle.loads(told)) if told else Ended(os.waitstatus_to_exitcode(ended), "", "", 0.0, 0)


def _child(writer: int, arguments: tuple[object, ...]) -> None:
    """Call the command, tell how it ended, and end this process without any cleaning up of the parent's."""
    try:
        pages, resident = map(int, Path("/proc/self/statm").read_text().split()[:2])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ADDRESSES,) * 2)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(6 * SECONDS)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))  # a fork has computed nothing yet
        ended = command_line.call(*arguments)
        used = resource.getrusage(resource.RUSAGE_SELF)
        grown = 1024 * used.ru_maxrss - resident * resource.getpagesize()
        with open(writer, "wb") as pipe:
            pipe.write(pickle.dumps((*ended, used.ru_utime + used.ru_stime, grown)))
    finally:
        os._exit(1)
