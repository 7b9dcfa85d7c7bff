"""Commands that are killed, and fits that are interrupted."""

from __future__ import annotations

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
    own = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"DDCO_PYRO_CACHE": str(cache)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    process = subprocess.Popen([COMMAND, *map(str, arguments)], cwd=folder, env=own, **quiet)
    with contextlib.suppress(subprocess.TimeoutExpired):
        assert process.wait(timeout=seconds) == 0
        return False
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return True


class Interrupting:
    """Ctrl-C at the end of so many epochs."""

    def __init__(self, epochs: int) -> None:
        self.left = epochs

    def __call__(self, event: object) -> None:
        self.left -= isinstance(event, EpochEnded)
        if self.left == 0:
            raise KeyboardInterrupt
