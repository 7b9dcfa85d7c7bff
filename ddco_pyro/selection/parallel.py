"""Folds in parallel: over the cores of this machine, or over the workers of a dask scheduler."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from joblib import Parallel, parallel_config

from ddco_pyro.selection.folds import Folds
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.selection.scoring import Score, score
from ddco_pyro.training.jobs import ALL_CORES, BackendError, check_jobs, results
from ddco_pyro.training.jobs import pool as processes

Pending = Sequence[tuple[Candidate, int]]

CONNECT_SECONDS = 10


@dataclass(frozen=True)
class Workers:
    """Who runs the folds: ``jobs`` processes here (-1: one for each core), or the workers of a dask ``scheduler``.

    :raises BackendError: no process at all.
    """

    jobs: int = ALL_CORES
    scheduler: str | None = None

    def __post_init__(self) -> None:
        check_jobs(self.jobs)

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
    if workers.scheduler is None:
        with processes(workers.jobs) as parallel:
            yield parallel
        return
    with _client(workers.scheduler), parallel_config(backend="dask"), processes(workers.jobs) as parallel:
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
    calls = [partial(score, folds, candidate, fold) for candidate, fold in pending]
    yield from results(
        parallel,
        calls,
        "a process that trained a fold was ended from outside (too little memory?); what was scored is kept: "
        "continue with --resume, with fewer --jobs if memory was short",
    )
