"""Work in a forked child, within limits of time and memory: no import is paid again."""

import os
import pickle
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

SECONDS = 10
"""Of computing; one that waits, for a pipe, ends after six times as long, however busy the machine is."""

ADDRESSES = 8 * 10**9
"""Bytes of address space beyond what the parent has: a command that reads without end fails in the child."""


class Ended(NamedTuple):
    """How a child ended.

    :param value: what its function returned; None where a signal ended it.
    :param status: negative where a signal ended it: SIGXCPU after :data:`SECONDS`, SIGALRM where it hangs.
    :param grown: bytes of memory that it had at most beyond those of the parent.
    """

    value: Any
    status: int
    grown: int


def run(work: Callable[[], Any]) -> Ended:
    """Call a function in a copy of this process."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        _child(writer, work)
    os.close(writer)
    with open(reader, "rb") as pipe:
        told = pipe.read()
    _, ended = os.waitpid(child, 0)
    return Ended(*pickle.loads(told)) if told else Ended(None, os.waitstatus_to_exitcode(ended), 0)


def _child(writer: int, work: Callable[[], Any]) -> None:
    """Tell what the function returns, and end this process without any cleaning up of the parent's."""
    try:
        pages, resident = map(int, Path("/proc/self/statm").read_text().split()[:2])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ADDRESSES,) * 2)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(6 * SECONDS)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 1))  # a fork has computed nothing yet
        value = work()
        grown = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - resident * resource.getpagesize()
        with open(writer, "wb") as pipe:
            pipe.write(pickle.dumps((value, 0, grown)))
    finally:
        os._exit(1)
