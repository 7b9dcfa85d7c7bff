"""HDF5: lazy arrays, one-line errors about missing or damaged parts, writing that survives a full disk."""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import h5py
import numpy as np

from ddco_pyro.data.arrays import LazyArray, block_steps, channels_last, refuse_too_much, turned
from ddco_pyro.data.demonstration import Attribute
from ddco_pyro.data.errors import DAMAGE, DemonstrationsError, Located, located, reading
from ddco_pyro.errors import nearest


@contextmanager
def opened(path: str | Path) -> Iterator[h5py.File]:
    """Open a file for reading; errors in the block name the file.

    :raises DemonstrationsError: the file is missing, not HDF5, or damaged.
    """
    if not os.path.exists(path):
        raise Located(f"{path}: there is no such file; check the path")
    if not os.path.isfile(path):
        raise Located(f"{path}: is no regular file; name an HDF5 file")
    with located(path), reading(Path(path)), h5py.File(path, "r") as file:
        yield file


class _Disk(io.FileIO):
    """A file that stops writing at the first error, kept in ``error``: HDF5 may crash when a write fails."""

    error: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        while rest and self.error is None:
            try:
                rest = rest[super().write(rest) :]
            except OSError as error:
                self.error = error
        return size

    def readinto(self, buffer: Any) -> int:
        """Read the file, with zeros in place of data that could not be written."""
        view = memoryview(buffer).cast("B")
        done = super().readinto(view) or 0
        view[done:] = bytes(len(view) - done)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0


@contextmanager
def written(path: Path, mode: Literal["w", "r+"] = "w") -> Iterator[h5py.File]:
    """Open an HDF5 file for writing; the first failed write is raised after closing.

    :param mode: ``w`` for a new file, ``r+`` to change a file.
    """
    with closing(_Disk(path, "w+" if mode == "w" else "r+")) as disk:
        try:
            with h5py.File(disk, mode) as file:
                yield file
        finally:
            if disk.error is not None:
                raise disk.error


def natural(name: str) -> list[tuple[int, str]]:
    """A sort key that puts ``demo_2`` before ``demo_10``."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def lazy(dataset: h5py.Dataset, where: str, steps: int | None = None) -> LazyArray:
    """A dataset as a lazy array; pictures have their channels last.

    Each pass opens the file: a folder can have more files than may be open.

    :param where: name in errors, such as ``demo_0: obs/camera``.
    :param steps: of the array, the first ones of the dataset; all if None.
    """
    path = os.path.abspath(dataset.file.filename)  # absolute for readers in another folder
    read = partial(_blocks, path, dataset.name, where, dataset.shape, dataset.dtype)
    shape = channels_last(dataset.shape, dataset.dtype)
    return LazyArray((shape[0] if steps is None else steps, *shape[1:]), dataset.dtype, read, where, path)


def _blocks(
    path: str, place: str, where: str, shape: tuple[int, ...], dtype: np.dtype, start: int, stop: int
) -> Iterator[np.ndarray]:
    with opened(path) as file:
        dataset = file.get(place)
        if (getattr(dataset, "shape", None), getattr(dataset, "dtype", None)) != (shape, dtype):
            raise DemonstrationsError(f"{where} has changed since it was looked at; do the same again")
        at_once = block_steps(shape[1:], dtype)
        for first in range(start, stop, at_once):
            yield turned(values_of(dataset, where, slice(first, min(first + at_once, stop))))


def values_of(dataset: h5py.Dataset, where: str, steps: slice = slice(None)) -> np.ndarray:
    """Values of a dataset, in memory.

    :raises DemonstrationsError: they are damaged, or take more memory than is free.
    """
    if steps == slice(None):
        refuse_too_much(dataset.nbytes, where, "divide the episode")
    try:
        return np.asarray(dataset[steps])
    except DAMAGE as error:
        raise DemonstrationsError(f"{where} cannot be read ({error}); the file may be damaged") from error


def datasets(group: h5py.Group, where: str = "", above: tuple[Any, ...] = ()) -> list[str]:
    """The names of all datasets below a group; keys of dm_control contain ``/``.

    :param above: the groups above this one.
    :raises DemonstrationsError: there is a link, or a group lies in itself.
    """
    names: list[str] = []
    for name in group:
        item = member(group, name, h5py.HLObject, where)
        if isinstance(item, h5py.Group):
            if item in (*above, group):
                circle = "its groups go in a circle; write it again without that"
                raise DemonstrationsError(f"{where}{name}: {circle}")
            names += [f"{name}/{below}" for below in datasets(item, f"{where}{name}/", (*above, group))]
        elif isinstance(item, h5py.Dataset):
            names.append(name)
    return sorted(names)


def dataset_at(group: h5py.Group, key: str, where: str) -> h5py.Dataset:
    """The dataset at ``key``, all of whose values are stored there; no value is read.

    :raises DemonstrationsError: the dataset is missing, not an array, elsewhere, or partly not stored, where
        HDF5 would read zeros.
    """
    dataset = member(group, key, h5py.Dataset, where)
    where = f"{where}{key}"
    if dataset.shape is None or dataset.ndim == 0:
        raise DemonstrationsError(f"{where} has no steps; it has to be an array")
    if dataset.is_virtual or dataset.external:
        place = "virtual" if dataset.is_virtual else "stored in another file"
        raise _elsewhere(f"{where} is {place}", dataset.file)
    what, claimed, there = "bytes", dataset.nbytes, dataset.id.get_storage_size()
    if dataset.chunks:
        what, there = "chunks", dataset.id.get_num_chunks()
        sides = zip(dataset.shape, dataset.chunks, strict=True)
        claimed = math.prod(-(-size // chunk) for size, chunk in sides)
    if there < claimed:
        holds = f"the file holds {there}; write it again"
        raise DemonstrationsError(f"{where} claims {claimed} {what}, but {holds}")
    return dataset


def _elsewhere(what: str, file: h5py.File) -> DemonstrationsError:
    whole = f"h5repack --merge -l CONTI {quote(file.filename)} whole.hdf5"
    remedy = f"where you trust it, write all into one file: {whole}"
    return DemonstrationsError(f"{what}, which is not read; {remedy}")


def member(group: h5py.Group, key: str, kind: type, where: str) -> Any:
    """A group or a dataset below ``group``; no link is followed.

    :raises DemonstrationsError: it is missing, of another kind, a link, or cannot be opened.
    """
    item: Any = group
    for part in filter(None, key.split("/")):
        link = item.get(part, getlink=True) if isinstance(item, h5py.Group) else None
        if link is None:
            known = datasets(group, where) if kind is h5py.Dataset else list(group)
            there = ", ".join(known) or "nothing"
            raise DemonstrationsError(f"{where}{key} is missing{nearest(key, known)}; there is: {there}")
        if not isinstance(link, h5py.HardLink):
            raise _elsewhere(f"{where}{key} is a link to {link.path}", group.file)
        try:
            item = item[part]
        except (KeyError, OSError, RuntimeError) as error:
            text = f"cannot be opened ({error}); the file may be damaged"
            raise DemonstrationsError(f"{where}{key} {text}") from error
    if not isinstance(item, kind):
        wanted, found = kind.__name__.lower(), type(item).__name__.lower()
        raise DemonstrationsError(f"{where}{key} has to be a {wanted}, not a {found}")
    return item


def attributes_of(owner: h5py.HLObject) -> dict[str, Attribute]:
    """The attributes that hold one number or text. Others are not read, because they can claim any size."""
    kinds = {name: owner.attrs.get_id(name) for name in owner.attrs}
    single = [
        name for name, kind in kinds.items()
        if kind.shape == () and (kind.dtype.kind in "iufb" or h5py.check_string_dtype(kind.dtype) is not None)
    ]  # fmt: skip
    values = {name: owner.attrs[name] for name in single}
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    return {name: value for name, value in plain.items() if isinstance(value, Attribute)}
