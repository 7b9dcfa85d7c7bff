"""Commands that are killed or terminated at random moments until they come to their end."""

from __future__ import annotations

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

COMMAND = Path(sys.executable).with_name("ddco-pyro")

HANGS = 600
"""A process that takes more seconds hangs, on however busy a machine."""


def environment(cache: Path) -> dict[str, str]:
    """With a cache of its own, one thread, and without what the tests' runner adds."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return {**kept, "DDCO_PYRO_CACHE": str(cache), "OMP_NUM_THREADS": "1"}


def whole(arguments: Sequence[object], folder: Path, cache: Path) -> float:
    """Run a command undisturbed; its seconds."""
    start, command = time.monotonic(), [COMMAND, *map(str, arguments)]
    subprocess.run(command, cwd=folder, env=environment(cache), check=True, capture_output=True, timeout=HANGS)
    return time.monotonic() - start


def started(command: Sequence[object], err: IO[str], folder: Path, **more: Any) -> subprocess.Popen[bytes]:
    """In a group of its own; ``err`` is no pipe, which orphans would keep open."""
    own = {"stdout": subprocess.DEVNULL, "stderr": err, "start_new_session": True}
    return subprocess.Popen([str(part) for part in command], cwd=folder, **own, **more)


Kept = Callable[[Path], set[object] | None]
"""What is safe in a folder, one thing each: it may only become more. None where all is done and it is put away."""


def until_done(
    arguments: Sequence[object],
    folder: Path,
    cache: Path,
    kills: int,
    seconds: float,
    seed: int,
    kept: Kept = lambda folder: None,
    by: signal.Signals = signal.SIGKILL,
) -> int:
    """Run a command again and again, killing it at random moments, ``kills`` times at most.

    Half of the time all its processes get the signal, as when a machine loses power; else it alone, and its helpers are
    orphans. Nothing that is kept is lost or made again.

    :param seconds: how long it takes undisturbed: moments lie within.
    :param by: SIGKILL; or SIGTERM, after which it says one line and leaves no process behind.
    :returns: how often it was killed.
    """
    choose, killed, safe = random.Random(seed), 0, set[object]()
    groups = []
    try:
        while True:
            with tempfile.TemporaryFile("w+") as err:
                process = started([COMMAND, *arguments], err, folder, env=environment(cache))
                groups.append(process.pid)
                limit = choose.uniform(0, seconds) if killed < kills else HANGS
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=limit)
                running = process.poll() is None
                if running:
                    assert killed < kills, "it hangs"
                    killed += 1
                    process.send_signal(by) if choose.random() < 0.5 else os.killpg(process.pid, by)
                    process.wait(timeout=HANGS)
                    answered(process, err, by)
                    running = by is signal.SIGKILL or process.returncode != 0  # or it had just come to its end
                now = kept(folder)
                assert now is None or safe <= now, f"lost or made again: {safe - now}"
                safe = now or set()
                if not running:
                    err.seek(0)
                    assert process.returncode == 0, err.read()
                    return killed
    finally:
        for group in groups:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)


INTERRUPTED = re.compile(r"(ddco-pyro: )?interrupted(; continue with: .*)?|ddco-pyro: .* was ended from outside .*")
"""What a command says last that was terminated; where its helpers are first to go, that."""


def answered(process: subprocess.Popen[bytes], err: IO[str], by: signal.Signals) -> None:
    """See that a terminated command has left no process behind, and has said so in a line, the last of all."""
    if by is signal.SIGKILL or process.returncode in (0, -by):  # killed, at its end, or not yet begun
        return
    for _ in range(100):
        if not _running(process.pid):
            break
        time.sleep(0.1)
    else:
        raise AssertionError("a process is left behind")
    err.seek(0)
    said = err.read()
    assert process.returncode == 1, said
    assert INTERRUPTED.fullmatch(said.splitlines()[-1]), said
    assert "Traceback" not in said


def _running(group: int) -> list[str]:
    """The processes of a group; those that have ended, and wait for somebody to notice, are none."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            state, _, its_group, *_ = path.read_text().rpartition(")")[2].split()
            found += [path.parent.name] if int(its_group) == group and state != "Z" else []
    return found
