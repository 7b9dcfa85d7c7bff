"""Many calls side by side, in processes that joblib keeps here or in those of its backends, such as dask."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.events import Event, OnEvent, ignore

Key = TypeVar("Key")
Result = TypeVar("Result")

ALL_CORES = -1
"""The number of ``jobs`` that stands for one for each core."""

# Of processes that are replaced, and calls that are given up.
_SAID = r"A worker stopped|\d+ tasks which were still being processed|\d+ tasks have been successfully"
warnings.filterwarnings("ignore", _SAID, UserWarning)


def from_outside(doing: str, fewer: str = "--jobs") -> str:
    """The message for a process that died, which did a part of the work; ``fewer`` sets their number."""
    return (
        f"a process that {doing} was ended from outside (too little memory?); what is done is kept in its "
        f"folder: continue with the same command and --out, with fewer {fewer} if memory was short"
    )


@dataclass(frozen=True)
class Workers:
    """Processes that do calls: ``jobs`` of them, -1: one for each core of this machine or joblib's backend.

    :raises BadInput: ``jobs`` is not a number of processes.
    """

    jobs: int = ALL_CORES

    def __post_init__(self) -> None:
        if self.jobs != ALL_CORES and self.jobs < 1:
            raise BadInput(f"--jobs {self.jobs}: give a number of processes, or -1 for one on each core")

    def number(self, calls: int = sys.maxsize) -> int:
        """The number of processes for so many calls, at most one for each call."""
        import joblib

        return min(joblib.effective_n_jobs(self.jobs), calls)


@contextmanager
def run_all(
    calls: Mapping[Key, Callable[..., Result]],
    workers: Workers,
    doing: str,
    on_event: OnEvent | None = None,
    ordered: bool = False,
    beside: bool = False,
    waiting: Mapping[Key, Event] | None = None,
) -> Iterator[Iterator[tuple[Key, Result]]]:
    """Inside, the key and the result of each call, as calls are completed.

    Other processes begin at once. Calls that have not ended with the block are given up, and their processes
    end. Where this process is the only one, a call is made when its result is asked for. A call makes its own
    calls alone.

    :param doing: what a call does, for the error.
    :param on_event: given to each call. Events of a call in another process are passed on once it is done.
    :param ordered: whether results come in the order of the calls.
    :param beside: whether this process works on something else inside the block.
    :param waiting: for ordered calls the event with which the wait for a call begins, passed on once.
    :raises Failed: a process died.
    """
    number, announced = workers.number(len(calls) + beside), waiting or {}
    if number <= 1:
        yield ((key, call(*([on_event] if on_event else []))) for key, call in calls.items())
        return
    import joblib

    parallel = joblib.Parallel(
        max(2, min(number, len(calls))),  # for one process joblib starts none
        return_as="generator" if ordered else "generator_unordered",
        batch_size=1,
        max_nbytes=None,  # arrays are copied: calls may write into theirs
        initializer=end_with,
        initargs=(os.getpid(),),
    )
    results = parallel(joblib.delayed(_away)(key, call, on_event is not None) for key, call in calls.items())

    def completed() -> Iterator[tuple[Key, Result]]:
        tell = on_event or ignore
        for expected in calls:
            if begun := announced.get(expected):
                tell(begun)
            key, result, events = next(results)
            for event in events:
                if event != begun:
                    tell(event)
            yield key, result

    with without_lost_calls():
        try:
            yield completed()
        except BrokenProcessPool as error:
            raise Failed(from_outside(doing)) from error
        finally:
            results.close()


@contextmanager
def without_lost_calls() -> Iterator[None]:
    """Inside, nothing is said of an error in loky's thread, which misses calls that were given up."""
    show = threading.excepthook

    def tell(error: threading.ExceptHookArgs) -> None:
        if error.exc_type is not KeyError or ".loky." not in type(error.thread).__module__:
            show(error)

    threading.excepthook = tell
    try:
        yield
    finally:
        threading.excepthook = show


def _away(key: Key, call: Callable[..., Result], with_events: bool) -> tuple[Key, Result, list[Event]]:
    """The key, the result and the events of a call in another process."""
    import joblib

    events: list[Event] = []
    with joblib.parallel_config("sequential"):
        return key, call(*[events.append][:with_events]), events


def end_with(parent: int) -> None:
    """Have this process end a moment after its parent, even by kill -9. Ctrl-C is left to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(0.1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
