"""Checks of what a foreign dataset's metadata says: paths stay in its folder, names can be stored, counts are right."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath

from ddco_pyro.data.hdf5 import DemonstrationsError

_PLACEHOLDER = re.compile(r"\{(\w+)(?::0(\d\d?)d)?\}")
_WIDEST = 12


def inside(folder: Path, relative: str | Path) -> Path:
    """The path ``folder / relative``, which lies in ``folder`` with all links followed; it need not exist.

    A dataset in the cache of the Hugging Face Hub may link to the cache's own ``blobs``, where its files lie.

    :raises DemonstrationsError: it leaves the folder, or is no path.
    """
    pure = PurePosixPath(relative)
    try:
        leaves = pure.is_absolute() or ".." in pure.parts
        resolved, root = (folder / pure).resolve(), folder.resolve()
        resolved.exists()  # raises where the name is too long
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a NUL
        what = getattr(error, "strerror", None) or error
        raise DemonstrationsError(f"{folder}: {str(relative)[:100]!r} is no path in it: {what}") from None
    if root.parent.name == "snapshots" and (blobs := root.parent.parent / "blobs").is_dir():
        leaves = leaves or not (resolved.is_relative_to(root) or resolved.is_relative_to(blobs))
    else:
        leaves = leaves or not resolved.is_relative_to(root)
    if leaves:
        raise DemonstrationsError(f"{folder}: {relative} leads out of the dataset; put the file itself into its folder")
    return folder / pure


def check_links(folder: Path) -> None:
    """See that a dataset's folder holds files and folders, and links to files in itself alone.

    :raises DemonstrationsError: a link leads out of it or to a folder, or something in it is no file.
    """
    for where, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(where, name)
            relative = path.relative_to(folder)
            if path.is_symlink():
                inside(folder, relative)
                if path.is_dir():
                    raise DemonstrationsError(
                        f"{folder}: {relative} is a link to a folder; put the folder itself there"
                    )
            elif name in files and not path.is_file():
                raise DemonstrationsError(f"{folder}: {relative} is no regular file; remove it")


def filled(folder: Path, template: str, values: Mapping[str, int | str]) -> str:
    """A template such as ``data/chunk-{chunk_index:03d}.parquet`` with its placeholders filled in.

    Numbers may be padded with zeros to a width of at most 12; no other format is known.

    :raises DemonstrationsError: it has other placeholders or formats.
    """

    def fill(found: re.Match[str]) -> str:
        name, width = found[1], int(found[2] or 0)
        value = values.get(name)
        if value is None or width > _WIDEST or (width and isinstance(value, str)):
            raise _unknown(folder, template, values)
        return str(value).zfill(width)

    if set(_PLACEHOLDER.sub("", template)) & set("{}"):
        raise _unknown(folder, template, values)
    return _PLACEHOLDER.sub(fill, template)


def _unknown(folder: Path, template: str, values: Iterable[str]) -> DemonstrationsError:
    known = ", ".join(f"{{{name}}}" for name in values)
    return DemonstrationsError(
        f"{folder}: the path {template[:200]!r} may have only {known}, and numbers as {{chunk_index:03d}}"
    )


def _storable(key: str) -> bool:
    """Whether HDF5 takes this path as it is."""
    try:
        length = len(key.encode())
    except UnicodeEncodeError:
        return False
    return length <= 1000 and "\0" not in key and all(part not in ("", ".") for part in key.split("/"))


def check_keys(folder: Path, keys: Iterable[str]) -> None:
    """See that observations can be stored under these keys beside each other.

    :raises DemonstrationsError: one is no path in HDF5, stands twice, or lies below another.
    """
    known: set[str] = set()
    for key in keys:
        if not _storable(key):
            raise DemonstrationsError(
                f"{folder}: an observation is called {key[:100]!r}, which cannot be stored; rename it"
            )
        if key in known:
            raise DemonstrationsError(f"{folder}: two observations are called {key!r}; rename one")
        known.add(key)
    for key in known:
        parts = key.split("/")
        for above in ("/".join(parts[:length]) for length in range(1, len(parts))):
            if above in known:
                raise DemonstrationsError(f"{folder}: observations are called {above!r} and {key!r}; rename one")


def first_missing(folder: Path, total: object, there: Collection[int], named: str) -> dict[int, str]:
    """The first episode that a dataset counts and does not have, with what is wrong; empty where all are there.

    :param total: the number of episodes that its metadata counts; not checked unless it is one.
    :param there: the numbers of its episodes.
    :param named: where they are, for messages.
    :raises DemonstrationsError: there are more than are counted.
    """
    if not isinstance(total, int) or total == len(there):
        return {}
    counts = f"the metadata counts {total} episodes, and {named} has {len(there)}"
    if total < len(there):
        raise DemonstrationsError(f"{folder}: {counts}; correct total_episodes")
    return {next(index for index in range(len(there) + 1) if index not in there): f"is missing: {counts}"}
