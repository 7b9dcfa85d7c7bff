"""Commands that are killed, and fits that are interrupted."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

from command_line import COMMAND

from ddco_pyro.events import EpochEnded

HANGS = 600
"""A process that takes more seconds hangs, on however busy a machine."""


def killed(arguments: Sequence[object], folder: Path, cache: Path, seconds: float) -> bool:
    """Run a command with a cache of its own, and kill it with all its helpers after so many seconds.

    :returns: whether it was killed, and had not ended before.
    """
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    own["DDCO_PYRO_CACHE"] = str(cache)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    process = subprocess.Popen([COMMAND, *map(str, arguments)], cwd=folder, env=own, **quiet)
    with contextlib.suppress(subprocess.TimeoutExpired):
        assert process.wait(timeout=seconds) == 0
        return False
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return True


def alive(process: int) -> bool:
    """Whether there is such a process; one that has ended, and waits for somebody to notice, is none."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (ProcessLookupError, FileNotFoundError):
        return False


class Interrupting:
    """Ctrl-C at the end of so many epochs."""

    def __init__(self, epochs: int) -> None:
        self.left = epochs

    def __call__(self, event: object) -> None:
        self.left -= isinstance(event, EpochEnded)
        if self.left == 0:
            raise KeyboardInterrupt
