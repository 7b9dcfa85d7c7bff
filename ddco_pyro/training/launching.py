"""The processes of a fit that train together: started here, or by ``torchrun``."""

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
from ddco_pyro.training.ranks import ALONE, LostProcess, Ranks, connected
from ddco_pyro.training.restarts import follow

HERE = "127.0.0.1"

PATIENCE = timedelta(days=1)
"""How long a process waits for the others, which may have much to do between exchanges. That one has ended is noticed
at once, since its connections are closed."""


LAUNCHED = {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"}
"""What ``torchrun`` says to the processes that it starts, in their environment."""


def launched() -> Ranks | None:
    """Which process of ``torchrun`` this is; None where it was not started by it."""
    if not os.environ.keys() >= LAUNCHED:
        return None
    return Ranks(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))


def requested(processes: int | None, launched: Ranks | None) -> int:
    """How many processes train together: as many as were asked for, 1 by default, under ``torchrun`` its own.

    :raises BackendError: ``torchrun`` started another number.
    """
    if launched is None:
        return 1 if processes is None else processes
    if processes not in (None, launched.size):
        raise BackendError(f"--processes {processes}: torchrun started {launched.size}; leave it out")
    return launched.size


def check_processes(processes: int, jobs: int, shards: int) -> None:
    """See that so many processes can train together.

    :raises BackendError: they cannot.
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
    """So many processes, of which this is the first: inside, the others train along (:func:`follow`).

    :raises LostProcess: another process has ended.
    :raises FailedProcess: another process has failed.
    """
    if processes == 1:
        yield ALONE
    elif distributed.is_initialized():  # by `leading`, which also says when that was all
        yield Ranks(0, processes)
    else:
        with _started(processes) as ranks:
            yield ranks
            ranks.share(None)  # that was all


@contextmanager
def leading(launched: Ranks | None) -> Iterator[None]:
    """Inside, the other processes of ``torchrun`` follow this one (:func:`follow_torchrun`); after it, they end.

    All that the first does belongs inside, refusals too: otherwise the others wait for it.
    """
    if launched is None or launched.size == 1:
        yield
        return
    store = _launchers(launched)
    try:
        with _joined(store, launched) as ranks:
            yield
            ranks.share(None)  # that was all
    except LostProcess:
        raise
    except BaseException:
        with suppress(RuntimeError):  # they took too long
            store.wait([_left(rank) for rank in range(1, launched.size)], LAST_WORDS)
        raise


LAST_WORDS = timedelta(seconds=5)
"""How long the first process waits, where it fails, for the others to read the reason: the store can end with it."""


def follow_torchrun(launched: Ranks) -> None:
    """Train along with the first of the processes that ``torchrun`` started, until it ends or something fails.

    The first alone says what has failed, and ends with status 1 or 2: ``torchrun`` ends all as soon as one does.

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
    """A process that trained together with this one has failed by itself."""

    def __init__(self, rank: int, error: str) -> None:
        super().__init__(f"process {rank}, which trained together with this one, has failed: {error}")


def _launchers(launched: Ranks) -> distributed.Store:
    """The store through which ``torchrun`` connects its processes."""
    with connected():
        store, *_ = next(distributed.rendezvous("env://", launched.rank, launched.size, timeout=PATIENCE))
    return store


@contextmanager
def _joined(store: distributed.Store, ranks: Ranks) -> Iterator[Ranks]:
    """Connected with the others. Where this process fails, the reason is left in the store for them.

    :raises LostProcess: another process has ended.
    :raises FailedProcess: it has left a reason.
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
        with suppress(RuntimeError):  # where the others have gone there is nobody to tell
            store.set(FAILED, f"{ranks.rank} {type(error).__name__}: {' '.join(str(error).split())}")
        raise
    finally:
        if distributed.is_initialized():
            distributed.destroy_process_group()


FAILED = "failed"
"""The key of a store for the rank of a process that failed, and its reason."""


ANSWERED_HERE = {signal.SIGINT, signal.SIGTERM}
"""Signals that the first process answers; it ends the others."""


@contextmanager
def _started(size: int) -> Iterator[Ranks]:
    """Connected with processes that are started, and ended, here."""
    store = distributed.TCPStore(HERE, 0, size, is_master=True, wait_for_workers=False)
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_follow, args=(Ranks(rank, size), store.port)) for rank in range(1, size)]
    resource_tracker.ensure_running()  # it would be started with the first of them, and unblock the signals
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
    """What a process that was started here does."""
    try:
        with connected():
            store = distributed.TCPStore(HERE, port, ranks.size, is_master=False)
            store.set(_name(ranks.rank), "")
        os.environ["LOCAL_RANK"] = str(ranks.rank)  # as torchrun does
        with _joined(store, ranks):
            follow(ranks)
    except Exception:
        sys.exit(1)  # the first process says what went wrong
