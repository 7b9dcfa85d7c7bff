"""Processes: jobs that work side by side (joblib), and ranks that train one restart together (``torch.distributed``).

All ranks come to the same exchanges in the same order. Results are passed on in the order of the calls that gave them,
whichever rank computed them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

import joblib
from joblib import Parallel, delayed
from torch import distributed

from ddco_pyro.errors import BadInput, Failed

Item = TypeVar("Item")
Result = TypeVar("Result")

ALL_CORES = -1
"""As a number of ``jobs``: one for each core."""


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


class LostProcess(Failed):
    """A process that trained together with this one has ended."""

    def __init__(self) -> None:
        super().__init__(
            "a process that trained together with this one was ended from outside (too little memory?); what was "
            "trained is kept in a run folder: continue with the same command, with fewer --processes if memory was "
            "short"
        )


@dataclass(frozen=True)
class Ranks:
    """The processes that train together.

    :param rank: the number of this one; 0 is the first, which alone writes and tells how it goes on.
    :param size: how many there are.
    """

    rank: int = 0
    size: int = 1

    def share(self, value: Any = None) -> Any:
        """What the first process gives, in each of them.

        :raises LostProcess: another process has ended.
        """
        if self.size == 1:
            return value
        values = [value]
        with connected():
            distributed.broadcast_object_list(values, src=0)
        return values[0]

    def own(self, items: Sequence[Item]) -> Sequence[Item]:
        """Those of which this process has the work where :meth:`each` is called for all of them."""
        return items[self.rank :: self.size]

    def each(self, calls: Iterable[Callable[[], Result]]) -> Iterator[Result]:
        """What the calls return, in their order, in each of the processes: they take turns in computing it.

        What a call raises is raised in all of them.

        :raises LostProcess: another process has ended.
        """
        if self.size == 1:
            yield from (call() for call in calls)
            return
        left = iter(calls)
        while turn := list(islice(left, self.size)):
            for result in self._gathered(turn[self.rank] if self.rank < len(turn) else None)[: len(turn)]:
                if isinstance(result, Exception):
                    raise result
                yield result

    def _gathered(self, call: Callable[[], Any] | None) -> list[Any]:
        """What the call of each process returned or raised; None where there was nothing left to call."""
        result: Any = None
        try:
            result = None if call is None else call()
        except Exception as error:  # the others wait for an answer
            result = error
        results: list[Any] = [None] * self.size
        with connected():
            distributed.all_gather_object(results, result)
        return results


ALONE = Ranks()
"""A process that trains by itself."""


@contextmanager
def connected() -> Iterator[None]:
    """Inside, a connection that is closed is a process that is lost; other errors are this process's own.

    :raises LostProcess: a connection is closed.
    """
    try:
        yield
    except distributed.DistError as error:  # of a store
        raise LostProcess from error
    except RuntimeError as error:
        if "/gloo/" not in str(error):  # gloo's own begin with the place in its sources
            raise
        raise LostProcess from error
