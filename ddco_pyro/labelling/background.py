"""Fits in another process, one piece of work at a time: how far it is, and ending it at once."""

from __future__ import annotations

import importlib
import os
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ddco_pyro.errors import Failed, reason
from ddco_pyro.events import EpochEnded, Event, TrainingBegan
from ddco_pyro.jobs import end_with, without_lost_calls

if TYPE_CHECKING:
    from joblib.externals.loky import ProcessPoolExecutor

Result = TypeVar("Result")

Call = Callable[..., Result]
"""What another process does; it is called with ``on_event``."""

Away = Callable[[Call[Any]], Any]
"""The result of a call in another process."""


@dataclass(eq=False)
class Work:
    """What is under way.

    :param message: what it is, as a person reads it.
    :param do: makes its calls by an :data:`Away`.
    :param calls: how many it makes.
    :ivar done: how many of them are done.
    """

    message: str
    do: Callable[[Away], None]
    calls: int
    done: int = field(init=False, default=0)


class Background:
    """One piece of work at a time, in a thread that waits for the calls of another process.

    :param lock: held while anything here changes.
    :param changed: called, with the lock, when work has ended.
    :param modules: what the process imports before it is asked for anything.
    :ivar work: None where nothing is under way.
    :ivar error: what failed at last, and why; empty where nothing did.
    """

    def __init__(self, lock: threading.RLock, changed: Callable[[], None], *modules: str) -> None:
        self.lock, self.changed, self.modules, self.error = lock, changed, modules, ""
        self.work: Work | None = None
        self._after: Work | None = None
        self._process: ProcessPoolExecutor | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="ddco-pyro-")
        self._told = Path(self._folder.name) / "done"

    def ready(self) -> None:
        """Start the process, which takes seconds, before it is asked for anything."""
        with self.lock:
            for module in self.modules:
                self._submit(partial(importlib.import_module, module))

    def begin(self, message: str, do: Callable[[Away], None], calls: int = 1) -> None:
        """Begin a piece of work, or do so when what is under way has ended."""
        with self.lock:
            work = Work(message, do, calls)
            if self.work is None:
                self.error = ""
                self._start(work)
            else:
                self._after = work

    def cancel(self) -> None:
        """End what is under way at once, and its process; what waits for it is given up."""
        with self.lock:
            if self.work is not None:
                self.work = self._after = None
                self._end()
                self.ready()
                self.changed()

    def close(self) -> None:
        """End the process."""
        with self.lock:
            self.work = self._after = None
            self._end()
            self._folder.cleanup()

    @property
    def progress(self) -> float | None:
        """The share of the work that is done; None where it is not known yet."""
        with self.lock:
            told = self._told.read_text().split() if self._told.exists() else []
            if self.work is None or not (told or self.work.done):
                return None
            return (self.work.done + float(told[-1] if told else 0)) / self.work.calls

    def _start(self, work: Work) -> None:
        self.work = work
        threading.Thread(target=self._do, args=(work,), daemon=True).start()

    def _do(self, work: Work) -> None:
        error = ""
        try:
            work.do(partial(self._away, work))
        except Exception as failed:  # the page says what has failed, and labelling goes on
            error = reason(failed)
        with self.lock:
            if self.work is not work:
                return  # it was cancelled
            self.error = error and f"{work.message} failed: {error}"
            if error:
                self._end()
            self.work, after, self._after = None, self._after, None
            self.changed()
            if after is not None:
                self._start(after)

    def _away(self, work: Work, call: Call[Result]) -> Result:
        """The result of a call in another process.

        :raises Failed: the work was cancelled, or the process was ended from outside.
        """
        with self.lock:
            self._refuse_cancelled(work)
            self._told.unlink(missing_ok=True)
            future = self._submit(partial(_telling, call, self._told))
        try:
            result = future.result()
        except BrokenProcessPool as error:
            raise Failed("its process was ended from outside (too little memory?)") from error
        with self.lock:
            self._refuse_cancelled(work)
            work.done += 1
            self._told.unlink(missing_ok=True)
        return result

    def _refuse_cancelled(self, work: Work) -> None:
        if self.work is not work:
            raise Failed("cancelled")

    def _submit(self, call: Callable[[], Result]) -> Future[Result]:
        """Have a call made by the process, which stays for the next call."""
        if self._process is None:
            from joblib.externals.loky import ProcessPoolExecutor

            self._process = ProcessPoolExecutor(1, initializer=end_with, initargs=(os.getpid(),))
        return self._process.submit(call)

    def _end(self) -> None:
        if self._process is not None:
            with without_lost_calls():
                self._process.shutdown(kill_workers=True)
            self._process = None


def _telling(call: Call[Result], file: Path) -> Result:
    """The result of a call, which adds the share of its epochs that are done to a file, a line for each event."""
    epochs, done = 0, 0
    with open(file, "a", buffering=1) as told:

        def tell(event: Event) -> None:
            nonlocal epochs, done
            epochs += (event.epochs or 0) if isinstance(event, TrainingBegan) else 0
            done += isinstance(event, EpochEnded)
            if epochs:
                told.write(f"{min(done / epochs, 1.0):.4f}\n")

        return call(on_event=tell)
