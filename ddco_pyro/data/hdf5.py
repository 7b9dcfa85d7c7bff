"""Reading HDF5 files of which nothing is believed: what is missing, damaged or claims too much is one clear line."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ddco_pyro.errors import BadInput, Failed, nearest

Attribute = float | int | str | bool

LARGEST_INFLATION = 1100  # deflate, the strongest of HDF5's usual filters, stores at most 1032 bytes in one
LARGEST_STEP = 64 * 2**20  # bytes; a picture of 4096 x 4096 in four colours
LARGEST_CHUNK = 256 * 2**20  # bytes; HDF5 unpacks whole chunks, whatever is asked for
# What h5py raises for a damaged file.
DAMAGE = (OSError, RuntimeError, ValueError, TypeError, KeyError, MemoryError)


class DemonstrationsError(BadInput):
    """Demonstrations that cannot be used; one line with the file, the demonstration and the key."""

    def __str__(self) -> str:
        return printable(super().__str__())


def printable(text: str) -> str:
    """A text as one line that does nothing to a terminal: names in a file can hold anything."""
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


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
    found: list[str] = []
    group.visititems(lambda name, one: found.append(name) if isinstance(one, h5py.Dataset) else None)
    return sorted(found)


def array_at(group: h5py.Group, key: str, where: str) -> np.ndarray:
    """The whole array at ``key``.

    :raises DemonstrationsError: it is missing, no array, damaged, or claims more than the file holds.
    """
    dataset = dataset_at(group, key, where)
    try:
        return np.asarray(dataset[()])
    except DAMAGE as error:
        raise DemonstrationsError(f"{where}{key} cannot be read ({error}); the file may be damaged") from error


def dataset_at(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    """The dataset at ``key``, which holds as much as it claims and can be read step by step; nothing of it is read.

    :raises DemonstrationsError: it is missing, no array, claims more than the file holds, or has giant steps or chunks.
    """
    dataset = member(group, key, h5py.Dataset, where)
    if dataset.shape is None or dataset.ndim == 0:
        raise DemonstrationsError(f"{where}{key} has no steps; it has to be an array")
    _refuse_claims(dataset, f"{where}{key}")
    _refuse_giants(dataset, f"{where}{key}")
    return dataset


def _refuse_claims(dataset: h5py.Dataset, name: str) -> None:
    """A damaged header can claim any size, and HDF5 would fill what is not in the file with zeros."""
    stored, files = dataset.id.get_storage_size(), "file holds"
    packed = dataset.id.get_create_plist().get_nfilters() > 0
    if dataset.is_virtual:
        folder = Path(dataset.file.filename).parent
        names = {one.file_name for one in dataset.virtual_sources()}
        sources = [Path(dataset.file.filename) if one == "." else folder / one for one in names]
        stored, files, packed = sum(one.stat().st_size for one in sources if one.is_file()), "files hold", True
    if dataset.nbytes > (LARGEST_INFLATION if packed else 1) * stored:
        raise DemonstrationsError(f"{name} claims {dataset.nbytes} bytes, but the {files} {stored}; write it again")


def _refuse_giants(dataset: h5py.Dataset, name: str) -> None:
    """What is read is read in blocks of at least a step, and of at least a chunk."""
    step, chunk = (math.prod(shape) * dataset.dtype.itemsize for shape in (dataset.shape[1:], dataset.chunks or ()))
    if step > LARGEST_STEP:
        raise DemonstrationsError(
            f"{name} takes {_megabytes(step)} at each step, and at most {LARGEST_STEP // 10**6} can be read; "
            "write less in a step"
        )
    if chunk > LARGEST_CHUNK:
        raise DemonstrationsError(
            f"{name} is stored in chunks of {_megabytes(chunk)}, and at most {LARGEST_CHUNK // 10**6} can be read; "
            "write smaller chunks"
        )


def _megabytes(size: int) -> str:
    return f"{size / 10**6:.0f} MB"


def member(group: h5py.Group, key: str, kind: type, where: str) -> Any:
    """A group or a dataset below ``group``."""
    try:
        found = group[key]
    except (KeyError, OSError):
        known = datasets(group) if kind is h5py.Dataset else list(group)
        raise DemonstrationsError(
            f"{where}{key} is missing{nearest(key, known)}; there is: {', '.join(known) or 'nothing'}"
        ) from None
    if not isinstance(found, kind):
        raise DemonstrationsError(
            f"{where}{key} has to be a {kind.__name__.lower()}, not a {type(found).__name__.lower()}"
        )
    return found


def names_in_mask(masks: h5py.Group, mask: str) -> tuple[str, ...]:
    """The names of demonstrations that a mask (robomimic: a filter key) lists.

    :raises DemonstrationsError: it is no list of names, or one that no memory can hold.
    """
    size = dataset_at(masks, mask, "mask/").nbytes
    if size > LARGEST_STEP:
        raise DemonstrationsError(
            f"mask/{mask} takes {_megabytes(size)}, and no list of names is that long; write it again"
        )
    names = array_at(masks, mask, "mask/").ravel().tolist()
    return tuple(name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in names)


def attributes_of(owner: h5py.HLObject) -> dict[str, Attribute]:
    """The attributes that hold one number or text. Others are not even read: a damaged one can claim any size."""
    kinds = {name: owner.attrs.get_id(name) for name in owner.attrs}
    single = [name for name, kind in kinds.items() if kind.shape == () and _is_number_or_text(kind.dtype)]
    values = {name: owner.attrs[name] for name in single}
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    return {name: value for name, value in plain.items() if isinstance(value, Attribute)}


def _is_number_or_text(dtype: np.dtype) -> bool:
    return dtype.kind in "iufb" or h5py.check_string_dtype(dtype) is not None
