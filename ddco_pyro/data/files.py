"""Files that are written whole or not at all, by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import glob
import json
import math
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ddco_pyro.errors import BadInput, Failed

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EACCES, errno.EBUSY, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR}


class NoSpace(Failed):
    """There is no room for a file; what was there before is as it was."""


class NotWritable(BadInput):
    """A place where nothing may be written."""


class Damaged(BadInput):
    """A file does not hold what was written into it."""

    def __init__(self, path: Path, what: str, remedy: str) -> None:
        super().__init__(path, what, remedy)

    def __str__(self) -> str:
        path, what, remedy = self.args
        return f"{path}: is damaged: {what}; {remedy}"


class Busy(BadInput):
    """Another process is writing there."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path``, which takes the place of ``path`` once the block has ended without an error.

    :raises NoSpace: the disk is full.
    :raises NotWritable: nothing may be written there.
    """
    with _explained(path):
        prefix = _prepared(path)
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=_TEMPORARY, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            _flush(temporary)
            temporary.chmod(0o644)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


_TEMPORARY = ".tmp"


def _flush(path: Path) -> None:
    """See that what was written is on the disk."""
    if path.is_file():
        with path.open("rb") as written:
            os.fsync(written.fileno())


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path``, which takes the place of ``path`` once the block has ended without an error.

    :raises NoSpace: the disk is full.
    :raises NotWritable: nothing may be written there.
    """
    with _explained(path):
        prefix = _prepared(path)
        temporary = Path(tempfile.mkdtemp(prefix=prefix, suffix=_TEMPORARY, dir=path.parent))
        try:
            yield temporary
            for file in temporary.rglob("*"):
                _flush(file)
            temporary.chmod(0o755)
            before = temporary.with_name(f"{prefix}before{_TEMPORARY}")
            if path.exists():
                path.rename(before)
            temporary.rename(path)
            shutil.rmtree(before, ignore_errors=True)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _prepared(path: Path) -> str:
    """How temporary names of this process beside ``path`` begin.

    What a process of this machine, killed while it wrote this very file or folder, has left is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    prefix = f".{path.name}-{platform.node()}-"
    for old in path.parent.glob(f"{glob.escape(prefix)}*{_TEMPORARY}"):
        process = old.name.removeprefix(prefix).partition("-")[0]
        if process.isdecimal() and not Path(f"/proc/{process}").exists():
            shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
    return f"{prefix}{os.getpid()}-"


def leftovers(folder: Path) -> list[Path]:
    """What processes that were killed left of files they were writing in this folder."""
    return [path for path in folder.glob(f".*{_TEMPORARY}") if path.is_file()]


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """What the system says of a place, in words."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise NoSpace(f"{path}: there is no room to write it; free some space, then do the same again") from error
        if error.errno in _FORBIDDEN:
            text = os.strerror(error.errno)
            raise NotWritable(f"{path}: cannot be written: {text}; choose another place or change this one") from error
        raise


@contextmanager
def only_one(folder: Path, wait: bool = False) -> Iterator[None]:
    """Nobody else writes in this folder, which is made where it is missing, while the block lasts.

    The lock is the system's: it ends with the process, however that ends, and leaves no file behind.

    :param wait: wait for another process to end rather than refuse.
    :raises Busy: another process holds the folder.
    :raises NotWritable: the folder cannot be made.
    """
    handle = _locked(folder, wait)
    try:
        yield
    finally:
        os.close(handle)


def _locked(folder: Path, wait: bool) -> int:
    while True:
        with _explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            os.close(handle)
            raise Busy(f"{folder}: another process is at work on it; wait for it, or choose another place") from None
        if folder.exists() and os.path.samestat(os.fstat(handle), folder.stat()):
            return handle
        os.close(handle)  # who held it has removed it meanwhile


def json_text(data: Any) -> str:
    """Plain data as JSON that ends with a new line. NaN, which JSON has not, is null; infinities are a ValueError."""
    return json.dumps(_without_nan(data), indent=1, allow_nan=False) + "\n"


def _without_nan(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _without_nan(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_without_nan(value) for value in data]
    return None if isinstance(data, float) and math.isnan(data) else data


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
