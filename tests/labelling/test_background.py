"""A call of the page in another process: how far it is, cancelling it, and processes ended from outside."""

import os
import signal
import sys
import threading
import time

import pytest
from killing import alive
from labelled import until

from ddco_pyro.events import EpochEnded, TrainingBegan
from ddco_pyro.labelling.background import Background


@pytest.fixture
def background():
    begun = Background(threading.RLock(), lambda: None, "colorsys")
    yield begun
    begun.close()


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


def test_a_call_says_how_far_it_is_and_ends_at_once_when_it_is_cancelled(background, tmp_path):
    found = []

    def prepared(result):
        return lambda: found.append(result)

    background.begin(training(tmp_path, 5, stop=False), prepared)
    until(lambda: background.progress == 0.5)
    pid = int((tmp_path / "pid").read_text())
    assert alive(pid)
    before = time.monotonic()
    background.cancel()
    assert time.monotonic() - before < 1
    assert (background.running, background.progress, background.error) == (False, None, "")
    until(lambda: not alive(pid))
    background.begin(training(tmp_path), prepared)
    until(lambda: not background.running)
    ((other, ready),) = found
    assert other != pid
    assert ready
    assert background.error == ""


def test_a_call_whose_process_is_ended_says_so_and_another_can_be_made(background, tmp_path):
    found = []
    background.begin(training(tmp_path, 1, stop=False), found.append)
    until(lambda: background.progress == 0.1)
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)
    until(lambda: not background.running)
    assert "its process was ended from outside" in background.error
    background.begin(training(tmp_path), lambda result: lambda: found.append(result))
    until(lambda: not background.running)
    assert (len(found), background.error) == (1, "")
