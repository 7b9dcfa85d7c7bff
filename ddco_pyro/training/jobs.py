"""Calls in processes: how many, in which order their results come, and what is said where a process dies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

import joblib
from joblib import Parallel, delayed

from ddco_pyro.errors import BadInput, Failed

ALL_CORES = -1
"""As a number of ``jobs``: one for each core."""

Result = TypeVar("Result")


class BackendError(BadInput):
    """Work cannot be done where it was asked for."""


def check_jobs(jobs: int) -> None:
    """See that ``jobs`` is a number of processes.

    :raises BackendError: it is not.
    """
    if jobs != ALL_CORES and jobs < 1:
        raise BackendError(f"--jobs {jobs}: give a number of processes, or -1 for one on each core")


def useful_jobs(jobs: int, calls: int) -> int:
    """The number of processes for so many calls: no more than there are calls."""
    return min(joblib.cpu_count() if jobs == ALL_CORES else jobs, calls)


def pool(jobs: int) -> Parallel:
    """Processes for :func:`results`, to be used in a ``with`` statement."""
    # One call at a time: each takes long, and whatever is done shall be kept at once.
    return Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)


def results(parallel: Parallel, calls: Iterable[Callable[[], Result]], dead: str) -> Iterator[Result]:
    """What the calls return, in the order in which they are done.

    :param dead: what to say where a process dies: what it did, and what to do.
    :raises Failed: a process died.
    """
    try:
        yield from parallel([delayed(call)() for call in calls])
    except BrokenProcessPool as error:
        raise Failed(dead) from error
