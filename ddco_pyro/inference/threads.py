"""The number of threads of the compiled engines, and of all numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import torch
from threadpoolctl import threadpool_limits


@contextmanager
def as_many_threads_as_torch() -> Iterator[None]:
    """Inside, compiled loops run on ``torch.get_num_threads()`` threads; torch's own number stays what it is."""
    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    torch.set_num_threads(threads)  # numba's first call has set OpenMP's number for the whole process, torch's too
    yield


@contextmanager
def one_thread() -> Iterator[None]:
    """Inside, torch, numpy and scikit-learn work on one thread: faster than on several where networks are small, and
    the same numbers everywhere, in any process.
    """
    before = torch.get_num_threads()
    with threadpool_limits(1):
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)
