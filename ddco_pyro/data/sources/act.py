"""HDF5 files of ACT and Mobile ALOHA, one for each episode."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import h5py
import numpy as np

from ddco_pyro.data.arrays import PICTURES, LazyArray, Observed, in_blocks
from ddco_pyro.data.demonstration import Demonstration
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.hdf5 import dataset_at, datasets, lazy, member, natural, opened, values_of
from ddco_pyro.data.sources import Source
from ddco_pyro.data.sources.metadata import joined

EPISODE = re.compile(r"episode_(\d+)\.(?:hdf5|h5)")


def open_act(path: Path) -> Iterator[Source]:
    """Files ``episode_0.hdf5``, ... with ``action`` [T, A] and ``observations/<key>`` [T, ...], or one.

    The ``base_action`` [T, B] of a mobile base is appended to the control. Pictures may be encoded, as bytes
    [T, longest].

    :raises DemonstrationsError: there are no episodes, or two have one number.
    """
    files = [path]
    if path.is_dir():
        names = sorted((one.name for one in path.iterdir() if EPISODE.fullmatch(one.name)), key=natural)
        files = [path / name for name in names]
    episodes: dict[str, Path] = {}
    for file in files:
        numbered = EPISODE.fullmatch(file.name)
        name = f"demo_{int(numbered[1]) if numbered else 0}"
        if name in episodes:
            raise DemonstrationsError(f"{file}: has the number of {episodes[name].name}; rename one")
        episodes[name] = file

    def read(name: str) -> Demonstration:
        with opened(episodes[name]) as file:
            control = {
                key: values_of(dataset_at(file, key, f"{name}: "), f"{name}: {key}")
                for key in ("action", "base_action")
                if key == "action" or key in file
            }
            keys = datasets(member(file, "observations", h5py.Group, f"{name}: "))
            observations = {key: _observation(file, key, name) for key in keys}
            return Demonstration.stored(name, observations, joined(control, name))

    yield Source(tuple(episodes), read)


def _observation(file: h5py.File, key: str, name: str) -> Observed:
    """An observation; encoded pictures [T, bytes] as uint8 [T, H, W, 3], in the encoded order of channels."""
    where = f"{name}: observations/{key}"
    dataset = dataset_at(file, f"observations/{key}", f"{name}: ")
    stored = lazy(dataset, where)
    if not key.startswith("images/") or dataset.dtype != PICTURES or dataset.ndim != 2 or not len(dataset):
        return stored

    def decoded(encoded: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        if picture is None or picture.shape != (shape or picture.shape):
            wrong = "cannot be decoded, or is of another size than the first"
            raise DemonstrationsError(f"{where}: a picture {wrong}")
        return picture

    shape = decoded(stored[0]).shape

    def read(start: int, stop: int) -> Iterator[np.ndarray]:
        encoded = (each for block in stored.read(start, stop) for each in block)
        return in_blocks((decoded(each, shape) for each in encoded), shape[:2])

    return LazyArray((len(stored), *shape), PICTURES, read, where)
