"""Many calls side by side, in processes of this machine or of a dask cluster.

Processes start and end here, and their signals are set here. ``torchrun`` alone starts others.
"""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain, islice
from multiprocessing import get_context
from typing import Any, TypeVar

from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.events import Event, OnEvent

Key = TypeVar("Key")
Result = TypeVar("Result")

ALL_CORES = -1
"""The number of ``jobs`` that stands for one for each core."""
LONG = 1000
"""Gradient steps, at least, of a training that takes longer than starting a process."""
CONNECT_SECONDS = 10
"""Time for a dask scheduler to answer."""

warnings.filterwarnings("ignore", "A worker stopped", UserWarning)
"""loky says so of a process that it replaces."""


def from_outside(doing: str, fewer: str = "--jobs") -> str:
    """The message for a process that died.

    :param doing: its part of the work.
    :param fewer: the setting for the number of processes.
    """
    return (
        f"a process that {doing} was ended from outside (too little memory?); what is done is kept in its folder: "
        f"continue with the same command and --out, with fewer {fewer} if memory was short"
    )


class BackendError(BadInput):
    """Work cannot be done by these processes or on this backend."""


@dataclass(frozen=True)
class Workers:
    """Processes that do calls: ``jobs`` of them here (-1: one for each core), or those of a dask ``scheduler``.

    :raises BackendError: ``jobs`` is not a number of processes.
    """

    jobs: int = ALL_CORES
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.jobs != ALL_CORES and self.jobs < 1:
            raise BackendError(f"--jobs {self.jobs}: give a number of processes, or -1 for one on each core")

    def number(self, calls: int = sys.maxsize) -> int:
        """The number of processes here for so many calls, at most one for each call."""
        import joblib

        return min(joblib.cpu_count() if self.jobs == ALL_CORES else self.jobs, calls)

    def check(self) -> None:
        """Check that the scheduler and its workers answer.

        :raises BackendError: dask is not installed, no scheduler answers, or the scheduler has no workers.
        """
        if self.scheduler is not None:
            with _cluster(self.scheduler):
                pass


@contextmanager
def run_all(
    calls: Mapping[Key, Callable[..., Result]],
    workers: Workers,
    doing: str,
    on_event: OnEvent | None = None,
    ordered: bool = False,
    beside: int | None = None,
    waiting: Mapping[Key, Event] | None = None,
) -> Iterator[Iterator[tuple[Key, Result]]]:
    """Inside, the key and the result of each call, as calls are completed.

    Other processes begin at once, and end with the block. Where this process is the only one, a call is made when its
    result is asked for.

    :param doing: what a call does, for the error.
    :param on_event: given to each call. Events of a call in another process are passed on once the call is completed.
    :param ordered: whether results come in the order of the calls.
    :param beside: the number of other calls that this process makes inside the block. This process then makes its
        share of ``calls``, before the results of other processes come in order. None where this process only waits.
    :param waiting: the event with which the wait for a call in another process begins; the event is passed on once.
    :raises Failed: a process died.
    :raises BackendError: as :meth:`Workers.check`.
    """
    number, announced = workers.number(len(calls) + (beside or 0)), waiting or {}
    shares = workers.scheduler is None and (number <= 1 or beside is not None)
    here = [*calls][number - 1 :: number] if calls and shares else []
    given = () if on_event is None else (on_event,)
    results = ((key, calls[key](*given)) for key in here)
    if len(here) == len(calls):
        yield results
        return
    try:
        with _cluster(workers.scheduler) if workers.scheduler else processes(number - shares) as (submit, at_once):
            left = ((submit(partial(_away, call, bool(given))), key) for key, call in calls.items() if key not in here)
            futures = dict(islice(left, at_once))

            def completed() -> Iterator[tuple[Key, Result]]:
                while futures:
                    future = next(iter(futures) if ordered or shares else as_completed(futures))
                    key = futures.pop(future)
                    if on_event and key in announced:
                        on_event(announced[key])
                    result, events = future.result()
                    futures.update(islice(left, 1))
                    for event in events:
                        if on_event and event != announced.get(key):
                            on_event(event)
                    yield key, result

            yield chain(results, completed())
    except BrokenProcessPool as error:
        raise Failed(from_outside(doing)) from error


def _away(call: Callable[..., Result], with_events: bool) -> tuple[Result, list[Event]]:
    """The result and the events of a call in another process."""
    events: list[Event] = []
    return call(*[events.append][:with_events]), events


Submit = Callable[[Callable[[], Any]], "Future[Any]"]
"""Has a call made by another process."""


@contextmanager
def _cluster(scheduler: str) -> Iterator[tuple[Submit, int]]:
    """Submits calls to the workers of a dask scheduler; also the number of calls at a time.

    :raises BackendError: as :meth:`Workers.check`.
    """
    try:
        from distributed import Client
    except ImportError:
        raise BackendError("--backend dask: dask is not installed; pip install 'ddco-pyro[dask]'") from None
    try:
        client = Client(scheduler, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise BackendError(
            f"--scheduler {scheduler}: no dask scheduler answers there within {CONNECT_SECONDS} s; start one with: "
            "dask scheduler"
        ) from error
    with client:
        if not (cores := client.ncores()):
            raise BackendError(f"--scheduler {scheduler}: has no workers; start some with: dask worker {scheduler}")
        # a submitted call keeps its demonstrations in the scheduler's memory
        yield client.get_executor(pure=False).submit, 2 * sum(cores.values())


_OPEN: list[tuple[int, Submit]] = []
"""The blocks of :func:`processes` around what is running: numbers of processes, and how calls are submitted."""


@contextmanager
def processes(number: int, *modules: str) -> Iterator[tuple[Submit, int]]:
    """Inside, so many processes do the calls of :func:`run_all`; those of a block around this one, if they suffice.

    They end with the block, or a moment after this process.

    :param modules: what the processes import at once. On Linux they are forks of this process, made after these
        imports: name modules only at the start of a command, where this process has no other threads.
    """
    import joblib
    from joblib.externals.loky import ProcessPoolExecutor

    if _OPEN and _OPEN[-1][0] >= number:
        yield _OPEN[-1][1], sys.maxsize
        return
    forks = bool(modules) and sys.platform == "linux"
    if forks:
        gc.disable()  # nothing that is imported is garbage
        for module in modules:
            importlib.import_module(module)
        gc.freeze()  # all processes share these pages
        gc.enable()
    context, threads = get_context("fork") if forks else None, str(max(1, joblib.cpu_count() // max(1, number)))
    settings = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", threads)}
    executor = cache(lambda: ProcessPoolExecutor(number, None, None, None, context, end_with, (os.getpid(),), settings))
    _OPEN.append((number, lambda call: executor().submit(call)))  # the first call starts the processes
    here = _OPEN[-1]
    for module in modules:
        here[1](partial(importlib.import_module, module))
    try:
        yield here[1], sys.maxsize
    finally:
        _OPEN.remove(here)
        if executor.cache_info().currsize:
            shown, threading.excepthook = (
                threading.excepthook,
                lambda _: None,
            )  # loky's thread misses calls that are gone
            executor().shutdown(kill_workers=True)
            threading.excepthook = shown


def end_with(parent: int) -> None:
    """Have this process end a moment after its parent, even by kill -9. Ctrl-C is left to the parent."""
    _OPEN.clear()  # a fork has those of its parent, and its handler of signals
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(0.1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
