"""Files that are written whole or not at all, by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import glob
import hashlib
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

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
        super().__init__(f"{path}: is damaged: {what}; {remedy}")


class Busy(BadInput):
    """Another process is writing there."""


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary name beside ``path``, which takes the place of ``path`` once the block has ended without an error.

    :raises NoSpace: the disk is full.
    :raises NotWritable: nothing may be written there.
    """
    with _explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale(path)
        prefix = f".{path.name}-{platform.node()}-{os.getpid()}-"
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
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale(path)
        prefix = f".{path.name}-{platform.node()}-{os.getpid()}-"
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


def _remove_stale(path: Path) -> None:
    """Remove what a process of this machine, killed while it wrote this very file or folder, has left."""
    prefix = f".{path.name}-{platform.node()}-"
    for old in path.parent.glob(f"{glob.escape(prefix)}*{_TEMPORARY}"):
        process = old.name.removeprefix(prefix).partition("-")[0]
        if process.isdecimal() and not Path(f"/proc/{process}").exists():
            shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)


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


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write named tensors and text metadata as safetensors, whole or not at all; equal contents give equal bytes.

    A checksum of both is written with them.
    """
    checked = {**metadata, CHECKSUM: _digest(tensors, metadata)}
    content = save({name: value.contiguous() for name, value in tensors.items()}, checked)
    with whole_file(path) as temporary:
        temporary.write_bytes(_metadata_in_order(content))


def _metadata_in_order(content: bytes) -> bytes:
    """The library writes metadata in random order. The header is JSON after its own length, padded to 8 bytes."""
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header.get("__metadata__", {}).items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[end:]


CHECKSUM = "sha256"


def _digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """SHA-256 of names, types, shapes, bytes and metadata."""
    found = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().contiguous()
        found.update(json.dumps([name, str(value.dtype), list(value.shape)]).encode())
        found.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return found.hexdigest()


def read_tensors(path: Path, remedy: str = "write it again") -> tuple[dict[str, Tensor], dict[str, str]]:
    """Named tensors and metadata of a safetensors file; what was written without a checksum is believed.

    :param remedy: what to do where it is damaged.
    :raises Damaged: it cannot be read, or does not hold what was written.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = dict(file.metadata() or {})
    except (SafetensorError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise Damaged(path, " ".join(str(error).split()), remedy) from error
    known = metadata.pop(CHECKSUM, None)
    if known is not None and known != _digest(tensors, metadata):
        raise Damaged(path, "its contents are not what was written", remedy)
    return tensors, metadata
