"""An environment of its own for packages that do not go with this project's, and what is run in it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from ddco_pyro.data.files import only_one, write_text
from ddco_pyro.errors import BadInput, Failed

MADE = ".made"
"""In the environment: the pins that it was made from, once all of them are installed."""

BAD_INPUT = 2
"""The exit status of a script that cannot use what it was given."""

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def made(folder: Path, pins: Path, python: str = sys.executable) -> Path:
    """The Python of the environment in ``folder``, which is made where it is not there, or of other pins.

    :raises Failed: it cannot be made; one line.
    """
    marker, wanted = folder / MADE, pins.read_text(encoding="utf-8")
    with only_one(folder, wait=True):
        if not marker.exists() or marker.read_text(encoding="utf-8") != wanted:
            pip = [str(_python(folder)), "-m", "pip", "install", "-q", "--no-compile", "--no-deps", "-r", str(pins)]
            for command in ([python, "-m", "venv", "--clear", str(folder)], pip):
                _run(command, f"{folder}: an environment with {pins.name} cannot be made")
            write_text(marker, wanted)
    return _python(folder)


def run(python: Path, script: Path, *arguments: str | Path) -> None:
    """Run a script on one thread.

    :raises BadInput: it says that what it was given cannot be used; its last line.
    :raises Failed: it ended with another error; its last line.
    """
    command = [str(python), "-W", "ignore", str(script), *map(str, arguments)]
    _run(command, f"{script.name} {arguments[0]} {arguments[1]}", ONE_THREAD)


def _python(folder: Path) -> Path:
    return folder / "bin" / "python"


def _run(command: list[str], what: str, environment: dict[str, str] | None = None) -> None:
    try:
        ended = subprocess.run(
            command, capture_output=True, text=True, check=False, env=os.environ | (environment or {})
        )
    except OSError as error:
        raise Failed(f"{what}: {command[0]}: {error.strerror}") from error
    if ended.returncode:
        said = (ended.stderr.strip() or ended.stdout.strip() or f"exit status {ended.returncode}").splitlines()
        raise (BadInput if ended.returncode == BAD_INPUT else Failed)(f"{what}: {said[-1].strip()}")
