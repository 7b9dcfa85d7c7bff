"""Npz files of OGBench: concatenated demonstrations."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from pathlib import Path
from zipfile import BadZipFile, ZipFile
from zlib import error as ZlibError

import numpy as np

from ddco_pyro.data.checks import NUMBERS
from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError
from ddco_pyro.data.memory import refuse_too_much
from ddco_pyro.data.pictures import channels_last, turned
from ddco_pyro.data.sources.hdf5_layouts import BARE
from ddco_pyro.data.sources.metadata import stored_keys
from ddco_pyro.data.sources.recording import Column, Recording, damaged

OBSERVATIONS, ACTIONS, TERMINALS, TIMEOUTS = "observations", "actions", "terminals", "timeouts"
SUFFIX = ".npy"
_DAMAGE = (OSError, ValueError, KeyError, EOFError, NotImplementedError, RuntimeError, BadZipFile, ZlibError)


class OGBench:
    """Arrays ``observations`` [N, ...], ``actions`` [N, A] and ``terminals`` [N], which is 1 in last steps.

    ``observations`` becomes ``obs/state``. Any other array of N steps, such as ``qpos``, is imported if it is asked
    for. An array is read whole, because an archive cannot be read in parts.
    """

    format = "ogbench"
    frequency: float | None = None
    masks: Mapping[str, tuple[str, ...]] = {}
    attributes: Mapping[str, Attribute] = {}

    def __init__(self, path: Path, archive: ZipFile) -> None:
        self.path, self.files, self._archive = path, (path,), archive
        self._array = cache(self._read)
        try:
            self._known = _headers(archive)
        except _DAMAGE as error:
            raise damaged(path, "", error) from error
        if missing := [key for key in (OBSERVATIONS, ACTIONS, TERMINALS) if key not in self._known]:
            raise DemonstrationsError(
                f"{path}: is an npz file without {', '.join(missing)}, which OGBench's files have; there is: "
                f"{', '.join(self._known) or 'nothing'}; write its episodes into HDF5 with the lines in docs/own.md"
            )
        steps = self._known[ACTIONS][0][:1]
        ends = [key for key in (TERMINALS, TIMEOUTS) if key in self._known]
        for key in (OBSERVATIONS, *ends):
            if self._known[key][0][:1] != steps:
                had, needed = (list(self._known[name][0]) for name in (key, ACTIONS))
                raise DemonstrationsError(f"{path}: {key} has shape {had}, and actions {needed}: the steps differ")
        if not any(steps):
            raise DemonstrationsError(f"{path}: holds no demonstrations; at least one is needed")
        self._spans = spans(np.any([self._array(key).reshape(*steps, -1).any(1) for key in ends], axis=0))
        self.names = tuple(self._spans)
        observed = [
            key
            for key, (shape, dtype) in self._known.items()
            if shape[:1] == steps and dtype.kind in NUMBERS and key not in (ACTIONS, *ends)
        ]
        preferred = [BARE if key == OBSERVATIONS else key for key in observed]
        self._keys = dict(zip(observed, stored_keys(path, observed, preferred), strict=True))

    def _read(self, key: str) -> np.ndarray:
        shape, dtype = self._known[key]
        refuse_too_much(math.prod(shape) * dtype.itemsize, f"{self.path}: {key}", "divide the file")
        try:
            with self._archive.open(key + SUFFIX) as stream:
                return np.lib.format.read_array(stream, allow_pickle=False)
        except _DAMAGE as error:
            raise damaged(self.path, key, error) from error

    def recording(self, name: str) -> Recording:
        """One demonstration; reading its arrays raises :class:`DemonstrationsError` if they are damaged."""
        observations = {key: self._column(array, name) for array, key in self._keys.items()}
        return Recording(name, observations, self._column(ACTIONS, name))

    def _column(self, key: str, name: str) -> Column:
        """A part of an array; one number per step becomes a vector."""
        shape, dtype = self._known[key]
        span = self._spans[name]
        shape = (span.stop - span.start, *(shape[1:] or (1,)))

        def blocks() -> Iterator[np.ndarray]:
            yield turned(self._array(key)[span].reshape(shape))

        return Column(channels_last(shape, dtype), dtype, blocks, named=key, aside=key not in (OBSERVATIONS, ACTIONS))


def spans(ends: np.ndarray) -> dict[str, slice]:
    """The steps of each demonstration by name, from the steps [N] that end one; so does the last step."""
    bounds = [0, *(np.flatnonzero(ends[:-1]) + 1).tolist(), len(ends)]
    return {f"demo_{number}": slice(*span) for number, span in enumerate(pairwise(bounds)) if len(ends)}


def _headers(archive: ZipFile) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """The shape and the type of each array, none of which is read."""
    found = {}
    for name in archive.namelist():
        if name.endswith(SUFFIX):
            with archive.open(name) as stream:
                one = np.lib.format.read_magic(stream) == (1, 0)
                read = np.lib.format.read_array_header_1_0 if one else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(stream)
            found[name.removesuffix(SUFFIX)] = shape, dtype
    return found


@contextmanager
def open_ogbench(path: Path) -> Iterator[OGBench]:
    """Open a file.

    :raises DemonstrationsError: the file cannot be read, has other arrays, or holds no demonstrations.
    """
    try:
        archive = ZipFile(path)
    except _DAMAGE as error:
        raise damaged(path, "", error) from error
    with archive:
        yield OGBench(path, archive)
