"""A call in another process: how far it is, and ending it at once."""

from __future__ import annotations

import importlib
import os
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ddco_pyro.errors import Failed, reason
from ddco_pyro.events import Counted, EpochEnded, Event, TrainingBegan
from ddco_pyro.jobs import end_with, without_lost_calls

if TYPE_CHECKING:
    from joblib.externals.loky import ProcessPoolExecutor

Call = Callable[..., Any]
"""What another process does; it is called with ``on_event``."""


class Background:
    """One call at a time in another process, which stays for the next one.

    :param lock: held while anything here changes.
    :param ended: called, with the lock, when a call has ended that was not cancelled.
    :param modules: what the process imports before it is asked for anything.
    :ivar error: why the last call failed; empty where it did not.
    """

    def __init__(self, lock: threading.RLock, ended: Callable[[], None], *modules: str) -> None:
        self.lock, self.ended, self.modules, self.error = lock, ended, modules, ""
        self._under_way: Future[Any] | None = None
        self._process: ProcessPoolExecutor | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="ddco-pyro-")
        self._told = Path(self._folder.name) / "done"

    def ready(self) -> None:
        """Start the process, which takes seconds, before it is asked for anything."""
        with self.lock:
            for module in self.modules:
                self._submit(partial(importlib.import_module, module))

    def begin(self, call: Call, prepare: Callable[[Any], Callable[[], None]]) -> None:
        """Make a call.

        :param prepare: gets the result in a thread of its own. What it gives is called, with the lock, unless
            the call was cancelled meanwhile.
        """
        with self.lock:
            self.error = ""
            self._told.unlink(missing_ok=True)
            self._under_way = self._submit(partial(_telling, call, self._told))
            threading.Thread(target=self._finish, args=(self._under_way, prepare), daemon=True).start()

    def cancel(self) -> None:
        """End what is under way at once, and its process."""
        with self.lock:
            if self.running:
                self._under_way = None
                self._end()
                self.ready()

    def close(self) -> None:
        """End the process."""
        with self.lock:
            self._under_way = None
            self._end()
            self._folder.cleanup()

    @property
    def running(self) -> bool:
        """Whether a call is under way."""
        return self._under_way is not None

    @property
    def progress(self) -> float | None:
        """The share of the call that is done; None where it is not known yet."""
        told = self._told.read_text() if self.running and self._told.exists() else ""
        return float(told) if told else None

    def _finish(self, call: Future[Any], prepare: Callable[[Any], Callable[[], None]]) -> None:
        failed: Exception | None = None
        try:
            take = prepare(call.result())
        except BrokenProcessPool:
            failed = Failed("its process was ended from outside (too little memory?)")
        except Exception as error:  # the page says what has failed, and labelling goes on
            failed = error
        with self.lock:
            if self._under_way is not call:
                return
            self._under_way = None
            if failed is None:
                take()
            else:
                self.error = reason(failed)
                self._end()
            self.ended()

    def _submit(self, call: Callable[[], Any]) -> Future[Any]:
        if self._process is None:
            from joblib.externals.loky import ProcessPoolExecutor

            self._process = ProcessPoolExecutor(1, initializer=end_with, initargs=(os.getpid(),))
        return self._process.submit(call)

    def _end(self) -> None:
        if self._process is not None:
            with without_lost_calls():
                self._process.shutdown(kill_workers=True)
            self._process = None


def _telling(call: Call, file: Path) -> Any:
    """The result of a call, which writes into a file which share of epochs or demonstrations are done."""
    epochs, done = 0, 0

    def tell(event: Event) -> None:
        nonlocal epochs, done
        if isinstance(event, Counted):
            epochs, done = event.total or 0, event.done or 0
        epochs += (event.epochs or 0) if isinstance(event, TrainingBegan) else 0
        done += isinstance(event, EpochEnded)
        if epochs:
            file.write_text(f"{min(done / epochs, 1.0):.4f}")

    return call(on_event=tell)
