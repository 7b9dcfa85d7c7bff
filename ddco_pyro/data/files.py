"""Files: checks of output places, atomic writes, folder locks, and JSON."""

from __future__ import annotations

import errno
import fcntl
import glob
import json
import math
import os
import platform
import secrets
import shutil
import stat
import tempfile
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ddco_pyro.errors import BadInput, Failed

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {
    errno.EACCES, errno.EBUSY, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR,
    errno.ENOTEMPTY, errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip


class Damaged(BadInput):
    """A file whose contents differ from what was written."""

    def __init__(self, path: Path, what: str, remedy: str) -> None:
        super().__init__(path, what, remedy)

    def __str__(self) -> str:
        path, what, remedy = self.args
        return f"{path}: is damaged: {what}; {remedy}"


class Busy(BadInput):
    """A folder that another process is writing."""


@dataclass(frozen=True)
class Output:
    """A place that a command writes to.

    :param option: its name in messages, such as ``--html``.
    :param kind: ``folder``; ``file``; or ``stream``, a file that never replaces an HDF5 file.
    """

    option: str
    path: Path
    kind: Literal["folder", "file", "stream"] = "stream"

    @property
    def place(self) -> Path:
        """The path with all links resolved."""
        return Path(os.path.realpath(self.path))

    def refused(self, why: str, remedy: str = "choose another place") -> BadInput:
        return BadInput(f"{self.option} {self.path}: {why}; {remedy}")


def check_outputs(outputs: Sequence[Output], inputs: Sequence[Path] = ()) -> None:
    """Refuse outputs that cannot be written, before a command starts to work. Nothing is changed.

    :param inputs: files and folders that the command reads; no output may be or lie in one of them, or in
        what links in them lead to.
    :raises BadInput: an output has an impossible name, is of another kind, cannot be written, is an input, or
        coincides with another output.
    :raises Failed: the disk is full.
    """
    for number, output in enumerate(outputs):
        name = str(output.path)
        if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
            raise BadInput(f"{output.option} {name!r}: is no name for a file; leave control characters out")
        with _explained(output.path):
            _check_kind(output)
            _check_writable(output)
        for path in inputs:
            for read in _places(path):
                if _same(output.path, read):
                    raise output.refused("is what this command reads")
                if read.is_dir() and read in output.place.parents:
                    raise output.refused(f"lies in {path}, which this command reads")
        if output.kind == "stream":
            from h5py import is_hdf5  # help loads nothing heavy

            if is_hdf5(output.path):
                remedy = "choose another place or remove it first"
                raise output.refused("is an HDF5 file, which this would replace", remedy)
        for other in outputs[:number]:
            if _same(output.path, other.path):
                raise output.refused(f"is also where {other.option} is written")
            if {other.kind, output.kind} & {"folder"} and (
                other.place in output.place.parents or output.place in other.place.parents
            ):
                raise output.refused(f"and {other.option} {other.path} lie in one another")


def _places(path: Path) -> set[Path]:
    """What a file or folder leads to: itself, and what links in it lead to, with all links resolved."""
    places, new = set[Path](), {Path(os.path.realpath(path))}
    while new:
        places |= new
        links = {link for place in new for link in place.rglob("*") if link.is_symlink()}
        new = {Path(os.path.realpath(link)) for link in links} - places
    return places


def _same(one: Path, other: Path) -> bool:
    """Whether two paths lead to one file, existing or not."""
    if one.exists() and other.exists():
        return one.samefile(other)
    return os.path.realpath(one) == os.path.realpath(other)


def _check_kind(output: Output) -> None:
    """Refuse an existing file or folder that the output cannot replace."""
    try:
        mode = output.path.stat().st_mode
    except FileNotFoundError:
        return
    if output.kind == "folder":
        if not stat.S_ISDIR(mode):
            raise output.refused("is a file", "name a folder")
    elif stat.S_ISDIR(mode):
        raise output.refused("is a folder", "name a file")
    elif not stat.S_ISREG(mode):
        raise output.refused("is no regular file")


def _check_writable(output: Output) -> None:
    """Refuse a place in which a file of the longest temporary name cannot be made."""
    place = output.place
    if place.is_file() and not os.access(place, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    there = next(path for path in (place, *place.parents) if path.is_dir())
    temporary = f"{_prefix(place)}{os.getpid()}-{'x' * 8}{2 * _TEMPORARY}"  # of the greatest length
    longest = max(len(os.fsencode(name)) for name in (*place.relative_to(there).parts, temporary))
    if longest > os.pathconf(there, "PC_NAME_MAX"):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except FileNotFoundError as error:  # as in /proc
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES)) from error


_TEMPORARY = ".tmp"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file that replaces ``path`` when the block ends without an error.

    Behind a link, the target is replaced.

    :raises Failed: the disk is full.
    :raises BadInput: nothing may be written there.
    """
    if path.exists() and not path.is_file():
        raise Output("", path).refused("is no regular file")
    with _whole(path) as temporary:
        temporary.touch()
        yield temporary


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A temporary folder that replaces ``path`` when the block ends without error, as :func:`whole_file`."""
    with _whole(path) as temporary:
        temporary.mkdir()
        yield temporary


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A temporary path for what is to replace ``path``; those that killed processes left here are removed."""
    with _explained(path):
        place = Path(os.path.realpath(path)) if path.is_symlink() else path
        place.parent.mkdir(parents=True, exist_ok=True)
        for old in place.parent.glob(f"{glob.escape(_prefix(place))}*{_TEMPORARY}"):
            process = old.name.removeprefix(_prefix(place)).partition("-")[0]
            if process.isdecimal() and not Path(f"/proc/{process}").exists():
                _remove(old)
        temporary = place.with_name(f"{_prefix(place)}{os.getpid()}-{secrets.token_hex(4)}{_TEMPORARY}")
        replaced = temporary.with_name(f"{temporary.name}{_TEMPORARY}")
        try:
            yield temporary
            for part in filter(Path.is_file, (temporary, *temporary.rglob("*"))):
                with part.open("rb") as written:
                    os.fsync(written.fileno())
            temporary.chmod(0o755 if temporary.is_dir() else 0o644)
            if place.is_dir():
                place.rename(replaced)
            temporary.rename(place)
        finally:
            if replaced.exists() and not place.exists():
                replaced.rename(place)
            _remove(replaced)
            _remove(temporary)


def _remove(path: Path) -> None:
    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _prefix(place: Path) -> str:
    return f".{place.name}-{platform.node()}-"


def leftovers(folder: Path) -> list[Path]:
    """Temporary files that killed processes left in a folder."""
    return [path for path in folder.glob(f".*{_TEMPORARY}") if path.is_file()]


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Translate OSError into a user-facing error."""
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            text = "there is no room to write it; free some space, then do the same again"
            raise Failed(f"{path}: {text}") from error
        if error.errno in _FORBIDDEN:
            text = f"cannot be written: {os.strerror(error.errno)}"
            raise BadInput(f"{path}: {text}; choose another place or change this one") from error
        raise


@contextmanager
def only_one(folder: Path, wait: bool = False) -> Iterator[None]:
    """Lock a folder for the block; a missing folder is made.

    The system releases the lock when the process ends, and no lock file is left.

    :param wait: wait for another process rather than refuse.
    :raises Busy: another process holds the lock.
    :raises BadInput: the folder cannot be made.
    """
    while True:
        with _explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            os.close(handle)
            text = "another process is at work on it; wait for it, or choose another place"
            raise Busy(f"{folder}: {text}") from None
        if folder.exists() and os.path.samestat(os.fstat(handle), folder.stat()):
            break
        os.close(handle)  # the last holder has removed the folder
    try:
        yield
    finally:
        os.close(handle)


def json_text(data: Any) -> str:
    """Plain data as JSON that ends with a new line.

    :raises ValueError: a number is infinite. NaN becomes null.
    """
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
