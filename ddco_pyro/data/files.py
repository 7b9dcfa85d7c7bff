"""Where a command may write, and files that are written whole or not at all, by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import glob
import json
import math
import os
import platform
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
    errno.EACCES, errno.EBUSY, errno.EPERM, errno.EROFS, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENOTEMPTY,
    errno.ENAMETOOLONG, errno.ELOOP,
}  # fmt: skip


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


@dataclass(frozen=True)
class Output:
    """A place that a command writes to.

    :param option: what names it in messages, such as ``--html``.
    :param kind: ``folder``; ``file``; or ``stream``, a file that is written from its beginning to its end, so that a
        character device such as ``/dev/null`` takes it too.
    """

    option: str
    path: Path
    kind: Literal["folder", "file", "stream"] = "stream"

    @property
    def place(self) -> Path:
        """The path without links."""
        return Path(os.path.realpath(self.path))

    def refused(self, why: str, remedy: str = "choose another place") -> NotWritable:
        """The error for it."""
        return NotWritable(f"{self.option} {self.path}: {why}; {remedy}")


def check_outputs(outputs: Sequence[Output], inputs: Sequence[Path] = ()) -> None:
    """See that a command may write its outputs, before it does any work. Nothing is changed.

    :param inputs: files and folders that the command reads. No output may be one of them, or lie in one of them.
    :raises NotWritable: an output has an impossible name, is of another kind, cannot be written, is an input, or is
        another output.
    :raises NoSpace: the disk is full.
    """
    for number, output in enumerate(outputs):
        _check_name(output)
        with _explained(output.path):
            _check_kind(output)
            _check_writable(output)
        for path in inputs:
            if _same(output.path, path):
                raise output.refused("is what this command reads")
            if path.is_dir() and Path(os.path.realpath(path)) in output.place.parents:
                raise output.refused(f"lies in {path}, which this command reads")
        if output.kind == "stream" and _is_hdf5(output.path):
            raise output.refused("is an HDF5 file, which this would replace", "choose another place or remove it first")
        for other in outputs[:number]:
            if _same(output.path, other.path):
                raise output.refused(f"is also where {other.option} is written")
            if {other.kind, output.kind} & {"folder"} and (
                other.place in output.place.parents or output.place in other.place.parents
            ):
                raise output.refused(f"and {other.option} {other.path} lie in one another")


def _same(one: Path, other: Path) -> bool:
    """Whether two paths lead to one file, by links too; where a file is missing, whether they would."""
    if one.exists() and other.exists():
        return one.samefile(other)
    return os.path.realpath(one) == os.path.realpath(other)


def _check_name(output: Output) -> None:
    name = str(output.path)
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
        raise NotWritable(f"{output.option} {name!r}: is no name for a file; leave control characters out")


_HDF5 = b"\x89HDF\r\n\x1a\n"
"""How an HDF5 file begins."""


def _check_kind(output: Output) -> None:
    """See that what is there already can be replaced by what is written."""
    try:
        mode = output.path.stat().st_mode
    except FileNotFoundError:
        return
    if output.kind == "folder":
        if not stat.S_ISDIR(mode):
            raise output.refused("is a file", "name a folder")
    elif stat.S_ISDIR(mode):
        raise output.refused("is a folder", "name a file")
    elif not (stat.S_ISREG(mode) or (stat.S_ISCHR(mode) and output.kind == "stream")):
        raise output.refused("is no regular file")


def _is_hdf5(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_HDF5)) == _HDF5


def _check_writable(output: Output) -> None:
    """See that files can be made there, with the names that are needed: permissions alone do not tell."""
    place = output.place
    if _is_device(output.path) or place.is_file():
        if not os.access(output.path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        if _is_device(output.path):
            return
    there = next(path for path in (place, *place.parents) if path.is_dir())
    names = (*place.relative_to(there).parts, _temporary_name(place))
    if max(len(os.fsencode(name)) for name in names) > os.pathconf(there, "PC_NAME_MAX"):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
    except FileNotFoundError as error:  # /proc says so
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES)) from error


def _is_device(path: Path) -> bool:
    return path.exists() and stat.S_ISCHR(path.stat().st_mode)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path``, which takes the place of ``path`` once the block has ended without an error.

    A link stays, and the file that it leads to is replaced. A character device is written into.

    :raises NoSpace: the disk is full.
    :raises NotWritable: nothing may be written there.
    """
    with _explained(path):
        if _is_device(path):
            with _poured_into(path) as temporary:
                yield temporary
            return
        if path.exists() and not path.is_file():
            raise Output("", path).refused("is no regular file")
        place = _target(path)
        handle, name = tempfile.mkstemp(prefix=_prepared(place), suffix=_TEMPORARY, dir=place.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            _flush(temporary)
            temporary.chmod(0o644)
            temporary.replace(place)
        finally:
            temporary.unlink(missing_ok=True)


def _target(path: Path) -> Path:
    """What a link leads to; the path itself where it is no link."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextmanager
def _poured_into(device: Path) -> Iterator[Path]:
    """A temporary file whose contents go into a device at the end."""
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / "file"
        temporary.touch()
        yield temporary
        with temporary.open("rb") as made, device.open("wb") as target:
            shutil.copyfileobj(made, target)


_TEMPORARY = ".tmp"


def _flush(path: Path) -> None:
    """See that what was written is on the disk."""
    if path.is_file():
        with path.open("rb") as written:
            os.fsync(written.fileno())


_REPLACED = f"-replaced{_TEMPORARY}"
"""How the name of a folder ends while another takes its place."""


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside ``path``, which takes the place of ``path`` once the block has ended without an error.

    A folder takes the place of another in two steps. Of a process that was killed between them, the folder that was
    there stays under a temporary name, and comes back when the next process writes there.

    :raises NoSpace: the disk is full.
    :raises NotWritable: nothing may be written there.
    """
    with _explained(path):
        place = _target(path)
        temporary = Path(tempfile.mkdtemp(prefix=_prepared(place), suffix=_TEMPORARY, dir=place.parent))
        replaced = temporary.with_name(temporary.name.removesuffix(_TEMPORARY) + _REPLACED)
        try:
            yield temporary
            for file in temporary.rglob("*"):
                _flush(file)
            temporary.chmod(0o755)
            if place.exists():
                place.rename(replaced)
            temporary.rename(place)
        finally:
            _put_back(replaced, place)
            for old in (replaced, temporary):
                shutil.rmtree(old, ignore_errors=True)


def _put_back(replaced: Path, place: Path) -> None:
    """Give a folder its name again, where nothing has taken its place."""
    if replaced.exists() and not place.exists():
        replaced.rename(place)


def _prepared(place: Path) -> str:
    """How temporary names of this process beside ``place`` begin.

    What a process of this machine, killed while it wrote this very file or folder, has left is removed; but the folder
    that it was replacing is put back.
    """
    place.parent.mkdir(parents=True, exist_ok=True)
    prefix = _prefix(place)
    for old in place.parent.glob(f"{glob.escape(prefix)}*{_TEMPORARY}"):
        if old.name.endswith(_REPLACED):
            _put_back(old, place)
        process = old.name.removeprefix(prefix).partition("-")[0]
        if process.isdecimal() and not Path(f"/proc/{process}").exists():
            shutil.rmtree(old, ignore_errors=True) if old.is_dir() else old.unlink(missing_ok=True)
    return f"{prefix}{os.getpid()}-"


def _prefix(place: Path) -> str:
    return f".{place.name}-{platform.node()}-"


def _temporary_name(place: Path) -> str:
    """A temporary name as long as they come."""
    return f"{_prefix(place)}{os.getpid()}-{'x' * 8}{_REPLACED}"


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
