"""Jobs: processes that work side by side, each on a call of its own (joblib)."""

from __future__ import annotations

import gc
import importlib
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar

import joblib
from joblib import Parallel, delayed
from joblib.externals.loky import ProcessPoolExecutor, get_reusable_executor

from ddco_pyro.data.pictures import end_with_parent
from ddco_pyro.errors import BadInput, Failed

Result = TypeVar("Result")

ALL_CORES = -1
"""The number of ``jobs`` that stands for one for each core."""
LONG = 1000
"""Gradient steps, at least, of a training that takes longer than starting a process."""


warnings.filterwarnings("ignore", ".*tasks (which were still|have been successfully)|A worker stopped", UserWarning)
"""joblib says so of calls that an interruption ends, and of a process that it replaces."""

_POOLED = threading.Event()  # :func:`pool` has been called


class BackendError(BadInput):
    """Work cannot be done by these processes or on this backend."""


def check_jobs(jobs: int) -> None:
    """Refuse what is no number of processes.

    :raises BackendError: ``jobs`` is none.
    """
    if jobs != ALL_CORES and jobs < 1:
        raise BackendError(f"--jobs {jobs}: give a number of processes, or -1 for one on each core")


def useful_jobs(jobs: int, calls: int) -> int:
    """The number of processes for so many calls, at most one for each call."""
    return min(joblib.cpu_count() if jobs == ALL_CORES else jobs, calls)


def pool(jobs: int, ordered: bool = False) -> Parallel:
    """Processes for :func:`results`, best used in a ``with`` statement; they end soon after this one, however it ends.

    :param ordered: whether results come in the order of the calls.
    """
    if jobs != 1:
        _POOLED.set()
    how = "generator" if ordered else "generator_unordered"
    # one call at a time: each takes long, and each result is kept at once; no read-only maps of arrays
    return Parallel(jobs, return_as=how, batch_size=1, max_nbytes=None, initializer=end_with_parent)


def end_pool() -> None:
    """End the processes of :func:`pool`, which wait for more calls: two seconds sooner than at the end of this one."""
    if _POOLED.is_set():
        get_reusable_executor(reuse=True).shutdown(kill_workers=True)
        _POOLED.clear()


@contextmanager
def importing(jobs: int, module: str) -> Iterator[None]:
    """Inside, the processes of :func:`pool` import a module while this one goes on."""
    number = useful_jobs(jobs, sys.maxsize)
    imported = pool(number)(delayed(_import)(module) for _ in range(number if number > 1 else 0))
    try:
        yield
    except BaseException:
        imported.close()
        raise
    list(imported)


def _import(module: str) -> None:
    importlib.import_module(module)


def results(parallel: Parallel, calls: Iterable[Callable[[], Result]], dead: str) -> Iterator[Result]:
    """The results of calls, as they are completed. Processes other than this one begin at once.

    :param dead: the message for a process that dies.
    :raises Failed: a process died.
    """
    return _sound(parallel([delayed(call)() for call in calls]), dead)


def _sound(found: Iterable[Result], dead: str) -> Iterator[Result]:
    """What is found.

    :raises Failed: a process died.
    """
    try:
        yield from found
    except BrokenProcessPool as error:
        raise Failed(dead) from error


def end_with(parent: int) -> None:
    """End this process where the process that waits for it is gone: another command may go on in the same folder."""
    if os.getppid() != parent:
        os._exit(1)


# --- processes beside this one ----------------------------------------------------------------------------------------

_EARLY: list[ProcessPoolExecutor] = []


@contextmanager
def early_process(*modules: str) -> Iterator[None]:
    """Inside, a process is ready for :func:`beside`. On Linux it is a fork of this process after the imports.

    Elsewhere its imports go on during those of this process: there a fork of a process with threads is not safe.

    :param modules: what it imports.
    """
    forks = sys.platform == "linux"
    if forks:
        gc.disable()  # nothing that is imported is garbage
        for module in modules:
            importlib.import_module(module)
        gc.freeze()  # both processes share these pages
        gc.enable()
    executor = ProcessPoolExecutor(1, context=get_context("fork") if forks else None, initializer=end_with_parent)
    _EARLY.append(executor)
    for module in modules:
        executor.submit(importlib.import_module, module)  # the first of them starts the process
    try:
        yield
    finally:
        _EARLY.remove(executor)
        executor.shutdown(kill_workers=True)


@contextmanager
def beside(workers: int, calls: Iterable[Callable[[], Result]], dead: str) -> Iterator[Iterator[Result]]:
    """Inside, other processes work on calls while this one does something else; the results, as they are completed.

    :param dead: the message for a process that dies.
    :raises Failed: a process died.
    """
    early = workers == 1 and bool(_EARLY)
    executor = _EARLY[-1] if early else ProcessPoolExecutor(workers, initializer=end_with_parent)
    try:
        futures = [executor.submit(call) for call in calls]
        yield _sound((future.result() for future in as_completed(futures)), dead)
    except BrokenProcessPool as error:  # before it was given any call
        raise Failed(dead) from error
    finally:
        if not early:
            executor.shutdown(kill_workers=True)
