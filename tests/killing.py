"""Commands that are killed at random moments until they come to their end."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

COMMAND = Path(sys.executable).with_name("ddco-pyro")


def environment(cache: Path) -> dict[str, str]:
    """With a cache of its own, one thread, and without what the tests' runner adds."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return {**kept, "DDCO_PYRO_CACHE": str(cache), "OMP_NUM_THREADS": "1"}


def whole(arguments: Sequence[object], folder: Path, cache: Path) -> float:
    """Run a command undisturbed; its seconds."""
    start = time.monotonic()
    subprocess.run(
        [COMMAND, *map(str, arguments)],
        cwd=folder,
        env=environment(cache),
        check=True,
        capture_output=True,
        timeout=600,
    )
    return time.monotonic() - start


def until_done(arguments: Sequence[object], folder: Path, cache: Path, kills: int, seconds: float, seed: int) -> int:
    """Run a command again and again, killing it (SIGKILL) at random moments, ``kills`` times at most; how often it was.

    :param seconds: how long it takes undisturbed: moments lie within.
    """
    choose, killed = random.Random(seed), 0
    while True:
        process = subprocess.Popen(
            [COMMAND, *map(str, arguments)],
            cwd=folder,
            env=environment(cache),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            limit = choose.uniform(0, seconds) if killed < kills else 600
            _, err = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # its helpers too: a machine that loses power spares none
            process.communicate()
            assert killed < kills, "it hangs"
            killed += 1
            continue
        assert process.returncode == 0, err.decode()
        return killed
