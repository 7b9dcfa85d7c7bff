"""HDF5 files: reading with one-line errors about missing or damaged parts, and writing that survives a full disk."""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from shlex import quote
from typing import Any, Literal

import h5py
import numpy as np

from ddco_pyro.errors import BadInput, Failed, nearest

Attribute = float | int | str | bool

DAMAGE = (OSError, RuntimeError, ValueError, TypeError, KeyError, MemoryError)
"""The errors of h5py about damaged files."""


class DemonstrationsError(BadInput):
    """Unusable demonstrations: one line with the file, the demonstration and the key."""

    def __str__(self) -> str:
        return printable(super().__str__())


def printable(text: str) -> str:
    """A text as one line without control characters, which names in a file can contain."""
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)


@contextmanager
def opened(path: str | Path) -> Iterator[h5py.File]:
    """Open a file for reading; errors in the block name the file.

    :raises DemonstrationsError: the file is missing, not HDF5, or damaged.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise DemonstrationsError(f"{path}: is no regular file; name an HDF5 file")
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
    """A file that stops writing at the first error and keeps it in ``error``: HDF5 may crash when a write fails."""

    def __init__(self, path: Path, mode: Literal["w+", "r+"]) -> None:
        super().__init__()
        self._file = io.FileIO(path, mode)
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all data."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        while rest and self.error is None:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                self.error = error
        return size

    def readinto(self, buffer: Any) -> int:
        """Read the file, with zeros in place of data that could not be written."""
        view = memoryview(buffer).cast("B")
        done = self._file.readinto(view) or 0
        view[done:] = bytes(len(view) - done)
        return len(view)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to an offset."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """The current offset."""
        return self._file.tell()

    def truncate(self, size: int | None = None) -> int:
        """Change the size of the file."""
        try:
            return self._file.truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


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


DEEPEST = 32
"""Deepest nesting of groups, of links to links, and of virtual datasets in virtual datasets."""

MOST_LINKS = 2_000
"""Most links below a group: with two links to each of 32 nested groups there are 4 · 10⁹ paths."""

PACKED, SMALL = 5_000, 10**9
"""Most bytes that a filtered dataset claims for each stored byte (deflate reaches 1032), or in all."""


def datasets(group: h5py.Group, where: str = "", external: bool = False) -> list[str]:
    """The names of all datasets below a group, linked datasets included; keys of dm_control contain ``/``.

    :param external: whether links to other files are followed.
    :raises DemonstrationsError: a link is broken or leads to another file, or groups are nested too deeply.
    """
    names: list[str] = []
    groups, links = [("", group, 1)], 0
    while groups:
        prefix, parent, depth = groups.pop()
        for name in parent:
            links += 1
            if depth > DEEPEST or links > MOST_LINKS:
                raise DemonstrationsError(
                    f"{where}{prefix[:40]}: its groups go in a circle, are nested more than {DEEPEST} deep, or hold "
                    f"more than {MOST_LINKS} links; write it again with fewer"
                )
            item = _linked(parent, name, f"{where}{prefix}{name}", external)
            if isinstance(item, h5py.Group):
                groups.append((f"{prefix}{name}/", item, depth + 1))
            elif isinstance(item, h5py.Dataset):
                names.append(prefix + name)
    return sorted(names)


def dataset_at(group: h5py.Group, key: str, where: str, external: bool = False, left: int = DEEPEST) -> h5py.Dataset:
    """The dataset at ``key``, all of whose values are stored; no value is read.

    :param external: whether the dataset may be in other files.
    :param left: how many virtual datasets may be nested.
    :raises DemonstrationsError: the dataset is missing, not an array, in another file, or partly not stored, where HDF5
        would read zeros.
    """
    dataset = member(group, key, h5py.Dataset, where, external)
    where = f"{where}{key}"
    if dataset.shape is None or dataset.ndim == 0:
        raise DemonstrationsError(f"{where} has no steps; it has to be an array")
    outside = _outside(dataset)
    if outside and not external:
        raise _elsewhere(where, outside, dataset.file)
    if dataset.is_virtual:
        _check_sources(dataset, where, external, left)
    elif dataset.external:
        _check_external(dataset, where)
    else:
        _check_stored(dataset, where)
    return dataset


def _check_stored(dataset: h5py.Dataset, where: str) -> None:
    """Refuse a dataset that claims more than its file holds."""
    stored = dataset.id.get_storage_size()
    filtered = stored and dataset.id.get_create_plist().get_nfilters()
    if dataset.nbytes > (max(PACKED * stored, SMALL) if filtered else stored):
        raise DemonstrationsError(f"{where} claims {dataset.nbytes} bytes, but the file holds {stored}; write it again")
    if dataset.chunks:
        needed = math.prod(-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
        there = dataset.id.get_num_chunks()
        if there < needed:
            raise DemonstrationsError(f"{where} claims {needed} chunks, but the file holds {there}; write it again")


def _check_external(dataset: h5py.Dataset, where: str) -> None:
    """Refuse a dataset whose raw files hold less than it claims."""
    claimed = dataset.nbytes
    for name, offset, size in dataset.external:
        path, part = Path(os.path.abspath(name)), min(size, claimed)
        if not path.is_file() or path.stat().st_size < offset + part:
            raise DemonstrationsError(f"{where}: {path} has to hold {part} bytes of it, but is missing or too short")
        claimed -= part


def _check_sources(dataset: h5py.Dataset, where: str, external: bool, left: int) -> None:
    """Refuse a virtual dataset with an unmapped part or a missing source."""
    if not left:
        raise DemonstrationsError(f"{where} is virtual, and so are its sources, in a circle; write it as an array")
    sources = dataset.virtual_sources()
    mapped = h5py.h5s.create_simple(dataset.shape)
    mapped.select_none()
    if sum(source.vspace.get_select_npoints() for source in sources) >= dataset.size:
        for source in sources:
            for start, stride, count, block in _boxes(source.vspace):
                mapped.select_hyperslab(start, count, stride, block, h5py.h5s.SELECT_OR)
    if mapped.get_select_npoints() < dataset.size:
        raise DemonstrationsError(f"{where} is virtual, and a part of it has no source; write it as an array")
    for source in sources:
        try:
            own = source.file_name == "."
            with nullcontext(dataset.file) if own else opened(_beside(dataset, source.file_name)) as file:
                there = dataset_at(file, source.dset_name, "", external, left - 1).shape
        except DemonstrationsError as error:
            raise DemonstrationsError(f"{where} is virtual: {error}") from None
        if source.src_space.get_select_type() == h5py.h5s.SEL_ALL:
            enough = math.prod(there) == source.vspace.get_select_npoints()
        else:
            last = source.src_space.get_select_bounds()[1]
            enough = len(last) == len(there) and all(end < size for end, size in zip(last, there, strict=True))
        if not enough:
            raise DemonstrationsError(
                f"{where} is virtual, and its source {source.file_name}: {source.dset_name} has another shape: {there}"
            )


def _boxes(space: Any) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Start, stride, count and block of each part of a selection."""
    if space.get_select_type() == h5py.h5s.SEL_ALL:
        yield (0,) * len(space.shape), (1,) * len(space.shape), space.shape, (1,) * len(space.shape)
    elif space.is_regular_hyperslab():
        yield space.get_regular_hyperslab()
    else:
        for first, last in space.get_select_hyper_blocklist():
            yield tuple(first), (1,) * len(first), tuple(last - first + 1), (1,) * len(first)


def _outside(dataset: h5py.Dataset) -> list[str]:
    """The other files that hold values of a dataset."""
    if dataset.is_virtual:
        names = {source.file_name for source in dataset.virtual_sources()} - {"."}
        return sorted(str(_beside(dataset, name)) for name in names)
    return sorted({os.path.abspath(name) for name, *_ in dataset.external or ()})


def _beside(item: h5py.HLObject, name: str) -> Path:
    return Path(os.path.abspath(item.file.filename)).parent / name


def _elsewhere(where: str, files: Sequence[str], file: h5py.File) -> DemonstrationsError:
    return DemonstrationsError(
        f"{where} lies in another file: {', '.join(files)}; where you trust that, copy it into one file: "
        f"ddco-pyro import {quote(file.filename)} --allow-external --out whole.hdf5"
    )


def outside_files(path: Path) -> list[str]:
    """The other files that an HDF5 file names as parts of itself; they need not exist.

    These are targets of external links, external storage, and sources of virtual datasets.

    :raises DemonstrationsError: the file cannot be read.
    """
    found: set[str] = set()
    with opened(path) as file:
        groups, known = [(file["/"], 1)], set()
        while groups:
            group, depth = groups.pop()
            for name in group:
                link = group.get(name, getlink=True)
                if isinstance(link, h5py.ExternalLink):
                    found.add(str(_beside(group, link.filename)))
                item = group[name] if isinstance(link, h5py.HardLink) else None
                if isinstance(item, h5py.Dataset):
                    found.update(_outside(item))
                elif isinstance(item, h5py.Group) and depth <= DEEPEST and item not in known:
                    known.add(item)
                    groups.append((item, depth + 1))
    return sorted(found)


def named(group: h5py.Group, key: str) -> bool:
    """Whether a group has a link of this name, possibly broken."""
    return group.get(key, getlink=True) is not None


def member(group: h5py.Group, key: str, kind: type, where: str, external: bool = False) -> Any:
    """A group or a dataset below ``group``.

    :param external: whether links to other files are followed.
    """
    try:
        item = _linked(group, key, f"{where}{key}", external)
    except KeyError:
        known = datasets(group, where, external) if kind is h5py.Dataset else list(group)
        raise DemonstrationsError(
            f"{where}{key} is missing{nearest(key, known)}; there is: {', '.join(known) or 'nothing'}"
        ) from None
    if not isinstance(item, kind):
        raise DemonstrationsError(
            f"{where}{key} has to be a {kind.__name__.lower()}, not a {type(item).__name__.lower()}"
        )
    return item


def _linked(group: h5py.Group, key: str, where: str, external: bool, left: int = DEEPEST) -> h5py.HLObject:
    """The object at a path, resolved link by link, so that no link to another file is followed unless allowed.

    :param left: how many soft links may be followed.
    :raises KeyError: a link is missing.
    :raises DemonstrationsError: a link is broken or leads to another file, or its target cannot be opened.
    """
    item: Any = group
    for part in filter(None, key.split("/")):
        link = item.get(part, getlink=True) if isinstance(item, h5py.Group) else None
        if link is None:
            raise KeyError(part)
        try:
            if isinstance(link, h5py.SoftLink):
                if not left:
                    raise KeyError(part)
                start = item.file if link.path.startswith("/") else item
                item = _linked(start, link.path, where, external, left - 1)
                continue
            if isinstance(link, h5py.ExternalLink):
                path = _beside(item, link.filename)
                if not external:
                    raise _elsewhere(where, [str(path)], item.file)
                if not path.is_file():
                    raise KeyError(part)
            item = item[part]
        except (KeyError, OSError, RuntimeError) as error:
            if isinstance(link, h5py.HardLink):
                raise DemonstrationsError(f"{where} cannot be opened ({error}); the file may be damaged") from error
            place = f"{link.path} of {link.filename}" if isinstance(link, h5py.ExternalLink) else link.path
            raise DemonstrationsError(f"{where} is a link to {place}, which leads nowhere") from None
    return item


def attributes_of(owner: h5py.HLObject) -> dict[str, Attribute]:
    """The attributes that hold one number or text. Other attributes are not read, because they can claim any size."""
    kinds = {name: owner.attrs.get_id(name) for name in owner.attrs}
    single = [name for name, kind in kinds.items() if kind.shape == () and _is_number_or_text(kind.dtype)]
    values = {name: owner.attrs[name] for name in single}
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
    return {name: value for name, value in plain.items() if isinstance(value, Attribute)}


def _is_number_or_text(dtype: np.dtype) -> bool:
    return dtype.kind in "iufb" or h5py.check_string_dtype(dtype) is not None
