"""Folds in parallel: over the cores of this machine, or over the workers of a dask scheduler."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from joblib import Parallel, delayed, parallel_config

from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.selection.folds import Folds
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.selection.scoring import Score, score

Pending = Sequence[tuple[Candidate, int]]

CONNECT_SECONDS = 10


class BackendError(BadInput):
    """The folds cannot be run where it was asked for."""


@dataclass(frozen=True)
class Workers:
    """Who runs the folds: ``jobs`` processes here (-1: one for each core), or the workers of a dask ``scheduler``.

    :raises BackendError: no process at all.
    """

    jobs: int = -1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.jobs != -1 and self.jobs < 1:
            raise BackendError(f"--jobs {self.jobs}: give a number of processes, or -1 for one on each core")

    def check(self) -> None:
        """See that they are there.

        :raises BackendError: dask is not installed, no scheduler answers, or it has no workers.
        """
        if self.scheduler is not None:
            with _client(self.scheduler):
                pass


@contextmanager
def pool(workers: Workers) -> Iterator[Parallel]:
    """Processes for as many calls of :func:`scores` as are needed.

    :raises BackendError: dask is not installed, no scheduler answers, or it has no workers.
    """
    # One task at a time: a fold takes long, and whatever has been scored shall be kept at once.
    settings = {"n_jobs": workers.jobs, "return_as": "generator_unordered", "batch_size": 1}
    if workers.scheduler is None:
        with Parallel(**settings) as parallel:
            yield parallel
        return
    with _client(workers.scheduler), parallel_config(backend="dask"), Parallel(**settings) as parallel:
        yield parallel


@contextmanager
def _client(scheduler: str) -> Iterator[None]:
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
        if not client.ncores():
            raise BackendError(f"--scheduler {scheduler}: has no workers; start some with: dask worker {scheduler}")
        yield


def scores(parallel: Parallel, folds: Folds, pending: Pending) -> Iterator[Score]:
    """The score of each of these (candidate, fold), in the order in which they are done.

    :raises Failed: a process died.
    """
    # The demonstrations travel inside the function: as an argument dask would keep them with a worker, and lose them
    # with it.
    calls = [delayed(partial(score, folds, candidate))(fold) for candidate, fold in pending]
    try:
        yield from parallel(calls)
    except BrokenProcessPool as error:
        raise Failed(
            "a process that trained a fold was ended from outside (too little memory?); what was scored is kept: "
            "continue with --resume, with fewer --jobs if memory was short"
        ) from error
