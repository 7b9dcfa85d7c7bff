"""Processes and devices: ranks that train one restart together, and what makes work on a device repeatable.

Ranks are started by ``torchrun`` and connected by ``torch.distributed``. All ranks come to the same exchanges
in the same order. Results are passed on in the order of their calls, whichever rank computed them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from itertools import islice
from typing import Any, TypeVar

import torch
from threadpoolctl import threadpool_limits
from torch import distributed

from ddco_pyro.errors import Failed
from ddco_pyro.jobs import from_outside
from ddco_pyro.model.seeding import HOST
from ddco_pyro.spec import SpecError, TrainingSpec

Result = TypeVar("Result")


LOST = from_outside("trained together with this one", "processes")
"""The message for another process that has ended."""


@dataclass(frozen=True)
class Ranks:
    """The processes that train a restart together.

    :param rank: the number of this one; process 0 alone writes files and reports progress.
    :param size: the number of processes.
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def here(cls) -> Ranks:
        """This process among those that :func:`together` has connected; elsewhere a single process."""
        if not distributed.is_initialized():
            return cls()
        return cls(distributed.get_rank(), distributed.get_world_size())

    def share(self, value: Any = None) -> Any:
        """The value that the first process gives, in each process.

        :raises Failed: another process has ended.
        """
        if self.size == 1:
            return value
        values = [value]
        with connected():
            distributed.broadcast_object_list(values, src=0)
        return values[0]

    def each(self, calls: Iterable[Callable[[], Result]]) -> Iterator[Result]:
        """The results of calls in order, in each process; the processes take turns in computing them.

        An error of a call is raised in each process.

        :raises Failed: another process has ended.
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
        """The result or error of each process's call; None without a call."""
        result: Any = None
        try:
            result = None if call is None else call()
        except Exception as error:  # the others wait for an answer
            result = error
        results: list[Any] = [None] * self.size
        with connected():
            distributed.all_gather_object(results, result)
        return results


LAUNCHED = {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"}
"""The environment variables of processes that ``torchrun`` starts."""

PATIENCE = timedelta(days=1)
"""How long a process waits for the others between exchanges. A process that ends is noticed at once, since
its connections close."""


@contextmanager
def together() -> Iterator[Ranks]:
    """Inside, this process is connected with the others of ``torchrun``; a process of its own is alone.

    The end of this block in the first process tells the others that there is no further model.

    :raises Failed: another process has ended.
    """
    if not os.environ.keys() >= LAUNCHED or os.environ["WORLD_SIZE"] == "1":
        yield Ranks()
        return
    with connected():
        distributed.init_process_group("gloo", timeout=PATIENCE)
    ranks = Ranks.here()
    try:
        yield ranks
        if ranks.rank == 0:
            ranks.share(None)
    finally:
        distributed.destroy_process_group()


@contextmanager
def connected() -> Iterator[None]:
    """Inside, a closed connection is a failure; other errors are this process's own.

    :raises Failed: a connection is closed.
    """
    try:
        yield
    except distributed.DistError as error:  # of a store
        raise Failed(LOST) from error
    except RuntimeError as error:
        if "/gloo/" not in str(error):  # gloo's errors begin with the place in its sources
            raise
        raise Failed(LOST) from error


# --- devices ------------------------------------------------------------------------------------------------

WORKSPACE = "CUBLAS_WORKSPACE_CONFIG"
"""The environment variable that makes the order of sums in cuBLAS fixed; CUDA reads it at its first use."""


def device_of(training: TrainingSpec) -> torch.device:
    """The device that a spec asks for; of several GPUs each process takes one (``LOCAL_RANK``).

    :raises SpecError: the machine has no such device.
    """
    if training.device == "cpu" or (training.device == "auto" and not torch.cuda.is_available()):
        return HOST
    if not torch.cuda.is_available():
        raise SpecError(
            f"training.device: cuda: torch {torch.__version__} has no GPU here; say cpu, or auto for a GPU "
            "where there is one"
        )
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)) % torch.cuda.device_count())


def described(device: torch.device) -> str:
    """The kind of a device, with the model of a GPU: the bits of a run depend on both."""
    return f"cuda ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else device.type


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Inside, a GPU gives the same bits each time, without TF32; nothing changes on the host."""
    if device.type != "cuda":
        yield
        return
    os.environ.setdefault(WORKSPACE, ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            yield
    finally:
        torch.use_deterministic_algorithms(before)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch, numpy and scikit-learn on one thread inside.

    Small networks run faster so, and results are the same in any process.
    """
    before = torch.get_num_threads()
    with threadpool_limits(1):
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)
