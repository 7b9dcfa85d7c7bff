"""Progress where there is no terminal: plain lines, seldom, with the time left; and the tables."""

from __future__ import annotations

import pytest

from ddco_pyro.cli import console
from ddco_pyro.events import (
    DemonstrationsDone,
    EpochEnded,
    TrainingBegan,
    TrainingEnded,
)


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves."""
    now = [0.0]
    monkeypatch.setattr("ddco_pyro.cli.console.time.monotonic", lambda: now[0])
    return now


def test_plain_lines_come_now_and_then_and_at_the_end(clock, capsys):
    with console.Progress() as progress:
        for done in range(1, 8):
            progress(DemonstrationsDone(done, 7))
            clock[0] += 4
    assert capsys.readouterr().err.splitlines() == [
        "collecting demonstrations: 4/7, 12 s left",
        "collecting demonstrations: 7/7, 0 s left",
    ]


@pytest.mark.parametrize(("epochs", "shown"), [(100, "3/100, 388 s left"), (None, "3")])
def test_a_fit_that_stops_early_says_so(clock, capsys, epochs, shown):
    """Where the number of epochs is open there is no time left."""
    with console.Progress() as progress:
        progress(TrainingBegan("ddco", epochs))
        for _ in range(3):
            clock[0] += 4
            progress(EpochEnded(0, "level-1", 1, 1.25, -0.5))
        progress(TrainingEnded("ddco"))
    assert capsys.readouterr().err.splitlines() == [
        f"training ddco: {shown}  level-1: training 1.250, tuning -0.500 nats/step",
        "training ddco: done after 3, 12 s",
    ]


def test_the_first_of_many_says_nothing_of_the_time_left(clock, capsys):
    """Restarts in processes: 30 s until they have begun, then one epoch each second."""
    with console.Progress() as progress:
        progress(TrainingBegan("ddco", 1000))
        for now in range(30, 42):
            clock[0] = now
            progress(EpochEnded(0, "joint", 1, 1.0, 0.5))
    first, second = capsys.readouterr().err.splitlines()
    assert first == "training ddco: 1/1000  joint: training 1.000, tuning 0.500 nats/step"
    assert second.startswith("training ddco: 12/1000, 988 s left")
