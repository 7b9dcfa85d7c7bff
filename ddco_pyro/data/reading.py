"""Pictures that will be needed soon are read by other processes meanwhile (``training.workers``)."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Hashable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from ddco_pyro.data.pictures import Observed, Transform, padded
from ddco_pyro.errors import Failed

DEAD = (
    "a process that read pictures was ended from outside (too little memory?); what was trained is kept in a run "
    "folder: continue with the same command, with fewer training.workers if memory was short"
)

Read = dict[str, np.ndarray]
"""Pictures by observation, [N, T, H, W, C]."""


class Job(NamedTuple):
    """What is to be read together.

    :param rows: what the trajectories are called.
    :param arrays: of each observation the pictures of each trajectory; ``transforms`` and ``shifts`` likewise.
    """

    rows: tuple[int, ...]
    arrays: Mapping[str, tuple[Observed, ...]]
    steps: slice
    transforms: Mapping[str, Transform]
    shifts: Mapping[str, np.ndarray]

    @property
    def key(self) -> Hashable:
        """Tells it from other jobs of the same plan."""
        return (*self.arrays, self.rows, self.steps.start, self.steps.stop)


def read(job: Job) -> Read:
    """Read it.

    :raises DemonstrationsError: a file cannot be read.
    """
    return {
        key: padded(arrays, job.steps, job.transforms[key], job.shifts.get(key)) for key, arrays in job.arrays.items()
    }


class Readers:
    """Processes that read what is planned, as far ahead as there are processes; with none it is read when taken.

    What is taken out of turn is read here: a plan can make reading fast, and never wrong.
    """

    def __init__(self, processes: int) -> None:
        self._processes = processes
        self._pool: ProcessPoolExecutor | None = None
        self._planned: Iterator[Job] = iter(())
        self._begun: deque[tuple[Hashable, Future[Read]]] = deque()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)

    def plan(self, jobs: Iterable[Job]) -> None:
        """What will be taken, in order; whatever was planned before is forgotten."""
        self._planned = iter(jobs if self._processes else ())
        self._begun.clear()
        self._begin()

    def take(self, job: Job) -> Read:
        """The pictures of a job.

        :raises DemonstrationsError: a file cannot be read.
        :raises Failed: a process died.
        """
        if not self._begun or self._begun[0][0] != job.key:
            return read(job)
        _, future = self._begun.popleft()
        self._begin()
        try:
            return future.result()
        except BrokenProcessPool as error:
            raise Failed(DEAD) from error

    def _begin(self) -> None:
        """Hand out as much as there are processes for, and one more."""
        while len(self._begun) <= self._processes:
            job = next(self._planned, None)
            if job is None:
                return
            try:
                self._begun.append((job.key, self._running().submit(read, job)))
            except BrokenProcessPool as error:
                raise Failed(DEAD) from error

    def _running(self) -> ProcessPoolExecutor:
        if self._pool is None:
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._processes, mp_context=spawn, initializer=_follow)
        return self._pool


def _follow() -> None:
    """A reader ends with the process that it reads for, also where that was killed, and not by Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None  # it was spawned

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
