"""Reading and writing HDF5: what is missing or damaged in a file is one clear line."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ddco_pyro.errors import BadInput, Failed, nearest

Attribute = float | int | str | bool

# What h5py raises for a damaged file.
DAMAGE = (OSError, RuntimeError, ValueError, TypeError, KeyError, MemoryError)


class DemonstrationsError(BadInput):
    """Demonstrations that cannot be used; one line with the file, the demonstration and the key."""

    def __str__(self) -> str:
        return printable(super().__str__())


def printable(text: str) -> str:
    """A text as one line that does nothing to a terminal: names in a file can hold anything."""
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)


@contextmanager
def opened(path: str | Path) -> Iterator[h5py.File]:
    """The file, open for reading; whatever is wrong with it is said with its path.

    :raises DemonstrationsError: there is no such file, it is no HDF5, or it is damaged.
    """
    try:
        with h5py.File(path, "r") as file:
            yield file
    except DemonstrationsError as error:
        raise DemonstrationsError(f"{path}: {error}") from None
    except (BadInput, Failed):
        raise
    except FileNotFoundError:
        raise DemonstrationsError(f"{path}: there is no such file; check the path") from None
    except DAMAGE as error:
        text = " ".join(str(error).split())
        raise DemonstrationsError(f"{path}: cannot be read as HDF5, or is damaged: {text}") from error


class _Disk(io.RawIOBase):
    """A file that keeps the first error of writing to itself: HDF5 can crash the process where a write fails.

    From then on nothing is written any more, and ``error`` says why.
    """

    def __init__(self, path: Path, mode: Literal["w+", "r+"]) -> None:
        super().__init__()
        self._file = io.FileIO(path, mode)
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of it."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        while rest and self.error is None:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                self.error = error
        return size

    def readinto(self, buffer: Any) -> int:
        """Read what is there, and zeros for what could not be written."""
        view = memoryview(buffer).cast("B")
        done = self._file.readinto(view) or 0
        view[done:] = bytes(len(view) - done)
        return len(view)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a place."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Where it is."""
        return self._file.tell()

    def truncate(self, size: int | None = None) -> int:
        """Cut it, or make it longer."""
        try:
            return self._file.truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def close(self) -> None:
        """Close it."""
        self._file.close()
        super().close()


@contextmanager
def written(path: Path, mode: Literal["w", "r+"] = "w") -> Iterator[h5py.File]:
    """An HDF5 file, open for writing; where a write fails, that is raised when all has been closed.

    :param mode: ``w`` for a new file, ``r+`` for changing one.
    """
    with closing(_Disk(path, "w+" if mode == "w" else "r+")) as disk:
        try:
            with h5py.File(disk, mode) as file:
                yield file
        finally:
            if disk.error is not None:
                raise disk.error


def natural(name: str) -> list[tuple[int, str]]:
    """Sorts ``demo_2`` before ``demo_10``."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def datasets(group: h5py.Group) -> list[str]:
    """The names of all datasets below a group; dm_control's own keys have a / in them."""
    names: list[str] = []
    group.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return sorted(names)


def dataset_at(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    """The dataset at ``key``; nothing of it is read.

    :raises DemonstrationsError: it is missing, no array, or claims more than the file holds: HDF5 would fill in zeros.
    """
    dataset = member(group, key, h5py.Dataset, where)
    if dataset.shape is None or dataset.ndim == 0:
        raise DemonstrationsError(f"{where}{key} has no steps; it has to be an array")
    stored = dataset.id.get_storage_size()
    packed = dataset.is_virtual or (stored and dataset.id.get_create_plist().get_nfilters())
    if dataset.nbytes > stored and not packed:
        raise DemonstrationsError(
            f"{where}{key} claims {dataset.nbytes} bytes, but the file holds {stored}; write it again"
        )
    return dataset


def member(group: h5py.Group, key: str, kind: type, where: str) -> Any:
    """A group or a dataset below ``group``."""
    try:
        item = group[key]
    except (KeyError, OSError):
        known = datasets(group) if kind is h5py.Dataset else list(group)
        raise DemonstrationsError(
            f"{where}{key} is missing{nearest(key, known)}; there is: {', '.join(known) or 'nothing'}"
        ) from None
    if not isinstance(item, kind):
        raise DemonstrationsError(
            f"{where}{key} has to be a {kind.__name__.lower()}, not a {type(item).__name__.lower()}"
        )
    return item


def attributes_of(owner: h5py.HLObject) -> dict[str, Attribute]:
    """The attributes that hold one number or text. Others are not even read: a damaged one can claim any size."""
    kinds = {name: owner.attrs.get_id(name) for name in owner.attrs}
    single = [name for name, kind in kinds.items() if kind.shape == () and _is_number_or_text(kind.dtype)]
    values = {name: owner.attrs[name] for name in single}
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    return {name: value for name, value in plain.items() if isinstance(value, Attribute)}


def _is_number_or_text(dtype: np.dtype) -> bool:
    return dtype.kind in "iufb" or h5py.check_string_dtype(dtype) is not None
