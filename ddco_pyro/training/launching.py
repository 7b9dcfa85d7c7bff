"""Starting the processes of a fit that train together, here or by ``torchrun``, and noticing which of them fail."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess

from torch import distributed

from ddco_pyro.errors import Failed
from ddco_pyro.training.jobs import BackendError
from ddco_pyro.training.processes import ALONE, LostProcess, Ranks, connected
from ddco_pyro.training.restarts import follow

HERE = "127.0.0.1"

PATIENCE = timedelta(days=1)
"""How long a process waits for the others between exchanges. A process that ends is noticed at once, since its
connections close."""

LAUNCHED = {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"}
"""The environment variables of processes that ``torchrun`` starts."""


def launched() -> Ranks | None:
    """This process among those of ``torchrun``; None where ``torchrun`` did not start it."""
    if not os.environ.keys() >= LAUNCHED:
        return None
    return Ranks(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))


def requested(processes: int | None, launched: Ranks | None) -> int:
    """The number of processes that train together: ``torchrun``'s own, else as many as asked for, 1 by default.

    :raises BackendError: ``torchrun`` started another number.
    """
    if launched is None:
        return 1 if processes is None else processes
    if processes not in (None, launched.size):
        raise BackendError(f"--processes {processes}: torchrun started {launched.size}; leave it out")
    return launched.size


def check_processes(processes: int, jobs: int, shards: int) -> None:
    """Refuse a number of processes that cannot train together.

    :raises BackendError: it is such a number.
    """
    if processes < 1:
        raise BackendError(f"--processes {processes}: give a number of processes")
    if processes > 1 and jobs != 1:
        raise BackendError(
            "--jobs trains restarts side by side, --processes shares the work of each gradient step; give one of them"
        )
    if processes > shards:
        raise BackendError(
            f"--processes {processes}: a minibatch is cut into training.shards={shards}, so that no more processes "
            f"have work; add --set training.shards={processes} (results depend on the shards, not on the processes)"
        )


@contextmanager
def together(processes: int) -> Iterator[Ranks]:
    """Inside, other processes train along with this one (:func:`follow`), ``processes`` in all.

    :raises LostProcess: another process has ended.
    :raises FailedProcess: another process has failed.
    """
    if processes == 1:
        yield ALONE
    elif distributed.is_initialized():  # by `leading`, which also ends it
        yield Ranks(0, processes)
    else:
        with _started(processes) as ranks:
            yield ranks
            ranks.share(None)  # no further model


@contextmanager
def leading(launched: Ranks | None) -> Iterator[None]:
    """Inside, the other processes of ``torchrun`` follow this one (:func:`follow_torchrun`); afterwards they end.

    Everything that the first process does belongs inside, refusals too: otherwise the others wait for it.
    """
    if launched is None or launched.size == 1:
        yield
        return
    store = _launchers(launched)
    try:
        with _joined(store, launched) as ranks:
            yield
            ranks.share(None)  # no further model
    except LostProcess:
        raise
    except BaseException:
        with suppress(RuntimeError):  # they took too long
            store.wait([_left(rank) for rank in range(1, launched.size)], LAST_WORDS)
        raise


LAST_WORDS = timedelta(seconds=5)
"""How long a failing first process waits for the others to read the reason from the store, which may end with it."""


def follow_torchrun(launched: Ranks) -> None:
    """Train along with the first process of ``torchrun``, until it ends or something fails.

    The first process alone reports a failure, and ends with status 1 or 2; ``torchrun`` then ends the others.

    :raises LostProcess: another process has ended.
    """
    store = _launchers(launched)
    try:
        with _joined(store, launched):
            follow(launched)
    except LostProcess:
        raise
    except Exception:
        return
    finally:
        with suppress(RuntimeError):
            store.set(_left(launched.rank), "")


def _left(rank: int) -> str:
    return f"left-{rank}"


class FailedProcess(Failed):
    """A process that trained together with this one has raised an error."""

    def __init__(self, rank: int, error: str) -> None:
        super().__init__(f"process {rank}, which trained together with this one, has failed: {error}")


def _launchers(launched: Ranks) -> distributed.Store:
    """The store through which ``torchrun`` connects its processes."""
    with connected():
        store, *_ = next(distributed.rendezvous("env://", launched.rank, launched.size, timeout=PATIENCE))
    return store


@contextmanager
def _joined(store: distributed.Store, ranks: Ranks) -> Iterator[Ranks]:
    """Inside, the processes are connected. The reason for which this process fails is left in the store.

    :raises LostProcess: another process has ended.
    :raises FailedProcess: another process has left a reason.
    """
    try:
        with connected():
            distributed.init_process_group(
                "gloo", store=store, rank=ranks.rank, world_size=ranks.size, timeout=PATIENCE
            )
        yield ranks
        with connected():
            distributed.barrier()
    except LostProcess:
        with connected():  # the store, too, may have ended with another process
            reason = store.get(FAILED).decode() if store.check([FAILED]) else ""
        if not reason:
            raise
        rank, _, error = reason.partition(" ")
        raise FailedProcess(int(rank), error) from None
    except BaseException as error:
        with suppress(RuntimeError):  # the store may have ended with the others
            store.set(FAILED, f"{ranks.rank} {type(error).__name__}: {' '.join(str(error).split())}")
        raise
    finally:
        if distributed.is_initialized():
            distributed.destroy_process_group()


FAILED = "failed"
"""The key of the store for the rank of a failed process and its reason."""


ANSWERED_HERE = {signal.SIGINT, signal.SIGTERM}
"""Signals that the first process handles: it ends the others."""


@contextmanager
def _started(size: int) -> Iterator[Ranks]:
    """Inside, the processes are connected that this function starts and ends."""
    store = distributed.TCPStore(HERE, 0, size, is_master=True, wait_for_workers=False)
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_follow, args=(Ranks(rank, size), store.port)) for rank in range(1, size)]
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")  # it cleans up after processes that are killed here
    try:
        resource_tracker.ensure_running()  # or the first process starts it, which unblocks the signals
    finally:
        sys.warnoptions.pop()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ANSWERED_HERE)  # they inherit it
    try:
        for other in others:
            other.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        _await(store, others)
        with _joined(store, Ranks(0, size)) as ranks:
            yield ranks
    finally:
        for other in others:
            other.kill()
            other.join()


def _await(store: distributed.Store, others: Sequence[BaseProcess]) -> None:
    """Wait until the others run.

    :raises LostProcess: one of them has ended.
    """
    names = [_name(rank) for rank in range(1, len(others) + 1)]
    while not store.check(names):
        if any(other.exitcode is not None for other in others):
            raise LostProcess
        time.sleep(0.05)


def _name(rank: int) -> str:
    return f"runs-{rank}"


def _follow(ranks: Ranks, port: int) -> None:
    """The main function of a process that :func:`_started` starts."""
    try:
        with connected():
            store = distributed.TCPStore(HERE, port, ranks.size, is_master=False)
            store.set(_name(ranks.rank), "")
        os.environ["LOCAL_RANK"] = str(ranks.rank)  # as torchrun does
        with _joined(store, ranks):
            follow(ranks)
    except Exception:
        sys.exit(1)  # the first process reports the reason
