"""A file of demonstrations that is made little by little: what is done is kept beside it until it is whole.

While ``demos.hdf5`` is made, the folder ``.demos.hdf5.parts`` holds its demonstrations in files of some each. Whoever
is killed leaves whole parts behind, and who makes the same file next goes on after them.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ddco_pyro.data.files import leftovers, only_one, whole_file, write_text
from ddco_pyro.data.hdf5 import Attribute, attributes_of, natural, opened, written
from ddco_pyro.data.sources.recording import Recording
from ddco_pyro.data.sources.robomimic import robomimic_file, write_recording

PART_BYTES = 64 * 2**20
"""A part is closed when it holds about so much, or so many recordings as its maker allows."""

PART_RECORDINGS = 64

_IDENTITY = "identity.json"


class Parts:
    """The parts of one file; made by :func:`parts_of`.

    ``done`` are the names of the demonstrations that are safe, in order.
    """

    def __init__(self, path: Path, folder: Path, at_most: int = PART_RECORDINGS) -> None:
        self.path, self.folder, self.at_most = path, folder, at_most
        self.done = [name for part in self._files() for name in _names(part)]
        self._open: list[Recording] = []
        self._bytes = 0

    def _files(self) -> list[Path]:
        return sorted(self.folder.glob("*.hdf5"))

    def add(self, recording: Recording) -> None:
        """Add a demonstration; it is safe once its part is closed."""
        self._open.append(recording)
        self._bytes += sum(column.dtype.itemsize * int(np.prod(column.shape)) for _, column in recording.columns())
        if self._bytes >= PART_BYTES or len(self._open) >= self.at_most:
            self.close()

    def close(self) -> None:
        """Make what has been added safe."""
        if not self._open:
            return
        part = self.folder / f"{len(self._files()):06d}.hdf5"
        with whole_file(part) as temporary, written(temporary) as file:
            for recording in self._open:
                write_recording(file, recording)
        self.done += [recording.name for recording in self._open]
        self._open, self._bytes = [], 0

    def attributes(self) -> list[dict[str, Attribute]]:
        """The attributes of every demonstration that is safe."""
        attributes = []
        for part in self._files():
            with opened(part) as file:
                attributes += [attributes_of(file[name]) for name in sorted(file, key=natural)]
        return attributes

    def finish(self, attributes: Mapping[str, Attribute], masks: Mapping[str, Sequence[str]]) -> None:
        """Put the file together."""
        self.close()
        with robomimic_file(self.path, attributes, masks) as data:
            for part in self._files():
                with opened(part) as source:
                    for name in sorted(source, key=natural):
                        source.copy(source[name], data, name)


def _names(part: Path) -> list[str]:
    with opened(part) as file:
        return sorted(file, key=natural)


@contextmanager
def parts_of(path: Path, identity: str, wait: bool = False, at_most: int = PART_RECORDINGS) -> Iterator[Parts | None]:
    """The parts of a file that is to be made; None where the file is there once nobody else makes it.

    :param identity: what determines the contents; parts of something else are removed.
    :param wait: wait for another process that makes it rather than refuse.
    :param at_most: demonstrations in a part; so many can be lost by an interruption.
    :raises Busy: another process is making this file.
    """
    folder = _folder(path)
    with only_one(folder, wait):
        if path.exists():
            shutil.rmtree(folder)
            yield None
            return
        known = folder / _IDENTITY
        if not known.exists() or known.read_text(encoding="utf-8") != identity:
            for old in folder.iterdir():
                old.unlink()
            write_text(known, identity)
        for old in leftovers(folder):
            old.unlink()
        parts = Parts(path, folder, at_most)
        try:
            yield parts
        finally:
            if path.exists() or not parts.done:
                shutil.rmtree(folder)


def discard(path: Path) -> None:
    """Remove the parts of a file that is whole, which its maker was killed before removing."""
    folder = _folder(path)
    if folder.exists():
        with only_one(folder):
            shutil.rmtree(folder)


def _folder(path: Path) -> Path:
    return path.with_name(f".{path.name}.parts")
