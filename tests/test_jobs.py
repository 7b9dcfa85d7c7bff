"""Processes beside this one (``training.jobs``)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from ddco_pyro.errors import Failed
from ddco_pyro.training.jobs import beside, early_process


def alive(process: int) -> bool:
    """Whether there is such a process, which is not a zombie."""
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_process_is_ready_before_there_is_work_and_ends_with_it() -> None:
    with early_process("json"):
        with beside(1, [os.getpid, os.getpid], "dead") as results:
            first = list(results)
        with beside(1, [os.getpid], "dead") as results:
            again = list(results)
    with beside(2, [os.getpid], "dead") as results:
        later = list(results)
    assert len(set(first + again)) == 1
    assert os.getpid() not in first + later
    assert first[0] != later[0]
    assert not alive(first[0])
    assert not alive(later[0])


def test_a_process_that_is_killed_is_one_line() -> None:
    kill = partial(signal.raise_signal, signal.SIGKILL)
    with beside(1, [kill], "a process was ended") as results, pytest.raises(Failed, match=r"^a process was ended$"):
        next(results)


def test_so_is_one_that_is_killed_before_there_is_work() -> None:
    with early_process("json"):
        with beside(1, [os.getpid], "dead") as results:
            (process,) = results
        os.kill(process, signal.SIGKILL)
        while alive(process):
            time.sleep(0.01)
        ended = beside(1, [os.getpid], "a process was ended")
        with pytest.raises(Failed, match=r"^a process was ended$"), ended as results:
            next(results)


KILLED = """
import os, signal
from ddco_pyro.training.jobs import beside, early_process
with early_process("json"), beside(1, [os.getpid], "dead") as results:
    print(*results, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_process_ends_with_the_one_that_is_killed_while_it_waits_for_work(tmp_path) -> None:
    with open(tmp_path / "process", "w") as file:
        killed = subprocess.run([sys.executable, "-c", KILLED], stdout=file)
    assert killed.returncode == -signal.SIGKILL
    process, deadline = int((tmp_path / "process").read_text()), time.monotonic() + 10
    while alive(process) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(process)
