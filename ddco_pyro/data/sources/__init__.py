"""Demonstrations as other libraries store them, each behind the same face: names, masks, and recordings read in blocks.

``robomimic`` HDF5 files (this project's own layout too), ``minari`` datasets and ``lerobot`` v3 datasets; HDF5 files of
``maniskill``, ``act`` and ``d4rl``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Protocol

from ddco_pyro.data.hdf5 import Attribute
from ddco_pyro.data.sources.layouts import format_of
from ddco_pyro.data.sources.recording import Column, Format, Recording

__all__ = ["Column", "Format", "Recording", "Source", "format_of", "open_source"]


class Source(Protocol):
    """A set of recordings that is open for reading."""

    @property
    def format(self) -> Format:
        """What wrote it."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its recordings, in order."""

    @property
    def masks(self) -> Mapping[str, tuple[str, ...]]:
        """Name to names of recordings (robomimic: filter keys)."""

    @property
    def frequency(self) -> float | None:
        """Control steps in a second, Hz, where the files say it."""

    @property
    def attributes(self) -> Mapping[str, Attribute]:
        """What is known of all of it."""

    @property
    def files(self) -> tuple[Path, ...]:
        """The files it is read from: their sizes and times tell whether it is still the same."""

    def recording(self, name: str) -> Recording:
        """One of them; its arrays can be read while the source is open."""


@contextmanager
def open_source(path: str | Path, form: Format | None = None, external: bool = False) -> Iterator[Source]:
    """Open a file or folder; the format is recognised unless it is given.

    :param external: whether parts of an HDF5 file may lie in other files.
    :raises DemonstrationsError: it cannot be read, or is not of this format.
    """
    path = Path(path)
    form = form or format_of(path)
    with _opener(form, external)(path) as source:
        yield source


def _opener(form: Format, external: bool) -> Callable[[Path], AbstractContextManager[Source]]:
    """Each imports what it needs: a library that is not installed is missed only by who needs it."""
    if form == "robomimic":
        from ddco_pyro.data.sources.robomimic import open_robomimic

        return partial(open_robomimic, external=external)
    if form == "minari":
        from ddco_pyro.data.sources.minari import open_minari

        return partial(open_minari, external=external)
    if form in ("maniskill", "act", "d4rl"):
        from ddco_pyro.data.sources.hdf5_layouts import open_layout

        return partial(open_layout, form=form)
    from ddco_pyro.data.sources.lerobot import open_lerobot

    return open_lerobot
