"""Work of the page in another process: how far it is, cancelling it, and processes that are ended from outside."""

import os
import signal
import sys
import threading
import time

import pytest
from killing import alive

from ddco_pyro.events import EpochEnded, TrainingBegan
from ddco_pyro.labelling.background import Background

PATIENCE = 20
"""Seconds that another process has to start."""


@pytest.fixture
def background():
    begun = Background(threading.RLock(), lambda: None, "colorsys")
    yield begun
    begun.close()


def until(holds):
    end = time.monotonic() + PATIENCE
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def training(folder, epochs=10, stop=True):
    """A call that says so many epochs of ten, and waits to be ended unless it is told to stop.

    Its process, and whether that is ready.
    """

    def train(on_event):
        (folder / "pid").write_text(str(os.getpid()))
        on_event(TrainingBegan("options", 10))
        for epoch in range(1, epochs + 1):
            on_event(EpochEnded(0, "options", epoch, 0.0, 0.0))
        while not stop:
            time.sleep(0.01)
        return os.getpid(), "colorsys" in sys.modules

    return train


def test_work_says_how_far_it_is_and_ends_at_once_when_it_is_cancelled(background, tmp_path):
    found, begun = [], []

    def two(away):
        found.append(away(training(tmp_path)))
        found.append(away(training(tmp_path, 5, stop=False)))

    background.begin("fitting", two, calls=2)
    background.begin("waits", lambda away: begun.append(away))
    until(lambda: background.progress == 0.75)  # one of two calls, and half of the other
    ((pid, ready),) = found
    assert alive(pid)
    assert not ready
    before = time.monotonic()
    background.cancel()
    assert time.monotonic() - before < 1
    assert (background.work, background.progress, background.error) == (None, None, "")
    until(lambda: not alive(pid))
    background.begin("fitting again", lambda away: found.append(away(training(tmp_path))))
    until(lambda: background.work is None)
    assert found[1][0] != pid
    assert found[1][1]
    assert (len(found), begun, background.error) == (2, [], "")


def test_work_that_fails_says_so_and_what_waits_for_it_begins(background, tmp_path):
    found, go_on = [], threading.Event()

    def ended(away):
        go_on.wait()
        away(training(tmp_path, 1, stop=False))

    background.begin("fitting", ended)
    background.begin("fitting once", found.append)
    background.begin("fitting again", lambda away: found.append(away(training(tmp_path))))  # in its place
    go_on.set()
    until((tmp_path / "pid").exists)
    said = []
    background.changed = lambda: said.append(background.error)
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)
    until(lambda: found and background.work is None)
    assert "fitting failed: its process was ended from outside" in said[0]
    assert (len(found), said[1]) == (1, "")
