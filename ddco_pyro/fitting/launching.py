"""The processes of a fit that train together: started here, or by ``torchrun``."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess

from torch import distributed

from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.fitting.processes import BackendError
from ddco_pyro.fitting.ranks import ALONE, LostProcess, Ranks, connected
from ddco_pyro.fitting.restarts import follow

HERE = "127.0.0.1"

PATIENCE = timedelta(days=1)
"""How long a process waits for the others, which may have much to do between exchanges. That one has ended is noticed
at once, since its connections are closed."""


LAUNCHED = {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"}
"""What ``torchrun`` says to the processes that it starts, in their environment."""


def requested(processes: int | None) -> Ranks:
    """Which of the processes of a fit this is, of so many as were asked for: 1 by default, under ``torchrun`` its own.

    :raises BackendError: ``torchrun`` started another number.
    """
    if not os.environ.keys() >= LAUNCHED:
        return Ranks(0, 1 if processes is None else processes)
    ranks = Ranks(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))
    if processes not in (None, ranks.size):
        raise BackendError(f"--processes {processes}: torchrun started {ranks.size}; leave it out")
    return ranks


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
    """
    if processes == 1:
        yield ALONE
        return
    started = _joined(None, Ranks(0, processes)) if os.environ.keys() >= LAUNCHED else _started(processes)
    with started as ranks:
        yield ranks
        ranks.share(None)  # that was all


def follow_torchrun(ranks: Ranks) -> None:
    """Train along with the first of the processes that ``torchrun`` started; ends this process where it fails.

    :raises LostProcess: another process has ended.
    """
    try:
        with _joined(None, ranks):
            follow(ranks)
    except LostProcess:
        raise
    except (BadInput, Failed):
        sys.exit(1)  # the first process has met the same, and says so


@contextmanager
def _joined(store: distributed.Store | None, ranks: Ranks) -> Iterator[Ranks]:
    """Connected with the others, through a store or as the environment says."""
    with connected():
        distributed.init_process_group("gloo", store=store, rank=ranks.rank, world_size=ranks.size, timeout=PATIENCE)
    try:
        yield ranks
    finally:
        distributed.destroy_process_group()


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
    except (BadInput, Failed):
        sys.exit(1)  # the first process says what went wrong
