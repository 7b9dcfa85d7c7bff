"""The processes that train a restart together, and how results pass between them (``torch.distributed``).

All of them come to the same exchanges in the same order. Who computes what decides nothing: results are passed on in
the order of the calls that gave them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, TypeVar

from torch import distributed

from ddco_pyro.errors import Failed

Item = TypeVar("Item")
Result = TypeVar("Result")


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
