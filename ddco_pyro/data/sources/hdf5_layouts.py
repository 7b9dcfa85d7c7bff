"""HDF5 files of ManiSkill and ACT, read in blocks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from shlex import quote

import cv2
import h5py
import numpy as np

from ddco_pyro.data.formats import EPISODE, TRAJECTORY
from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError, dataset_at, datasets, member, natural, opened
from ddco_pyro.data.pictures import block_steps
from ddco_pyro.data.sources.metadata import inside
from ddco_pyro.data.sources.recording import Column, Recording, as_vectors, joined, of_array, of_dataset

BARE = "state"
"""Key of an observation array without a name."""


class _Source(ABC):
    """Demonstrations that are groups of HDF5 files."""

    format: str
    frequency: float | None = None
    masks: Mapping[str, tuple[str, ...]] = {}
    attributes: Mapping[str, Attribute] = {}

    def __init__(self, path: Path) -> None:
        self.path = path
        self._places = self._found()
        if not self._places:
            raise DemonstrationsError(f"{path}: holds no demonstrations; at least one is needed")
        self.names = tuple(self._places)
        self.files = tuple(dict.fromkeys(file for file, _ in self._places.values()))

    @abstractmethod
    def _found(self) -> dict[str, tuple[Path, str]]:
        """The file and the group of each demonstration by name, in order."""

    def recording(self, name: str) -> Recording:
        """One demonstration."""
        path, group = self._places[name]
        with opened(path) as file:
            return self._read(name, member(file, group, h5py.Group, ""))

    @abstractmethod
    def _read(self, name: str, group: h5py.Group) -> Recording:
        """The demonstration in a group."""


class ManiSkill(_Source):
    """Groups ``traj_0``, ... with ``actions`` [T, A] and ``obs``, one array or a tree of arrays [T + 1, ...].

    The observation after the last action is left out.
    """

    format = "maniskill"

    def _found(self) -> dict[str, tuple[Path, str]]:
        with opened(self.path) as file:
            names = sorted((name for name in file if TRAJECTORY.fullmatch(name)), key=natural)
            if names and not any(_observed(member(file, name, h5py.Group, ""), name) for name in names):
                raise DemonstrationsError(
                    "has no observations; ManiSkill makes them: python -m mani_skill.trajectory.replay_trajectory "
                    f"--traj-path {quote(str(self.path))} --save-traj -o state"
                )
        return {name.replace("traj", "demo"): (self.path, name) for name in names}

    def _read(self, name: str, group: h5py.Group) -> Recording:
        actions = _column(group, "actions", name)
        steps = actions.shape[0]
        observations = {}
        for key, place in _observed(group, name).items():
            after = len(dataset_at(group, place, f"{name}: ")) == steps + 1
            observations[key] = _column(group, place, name, slice(steps) if after else slice(None))
        return Recording(name, observations, actions)


class Act(_Source):
    """Files ``episode_0.hdf5``, ... with ``action`` [T, A] and ``observations/<key>`` [T, ...].

    The ``base_action`` [T, B] of a mobile base is appended to the control. Pictures may be encoded, as bytes
    [T, longest].
    """

    format = "act"

    def _found(self) -> dict[str, tuple[Path, str]]:
        if self.path.is_dir():
            names = sorted((one.name for one in self.path.iterdir() if EPISODE.fullmatch(one.name)), key=natural)
            files = [inside(self.path, name) for name in names]
        else:
            files = [self.path]
        found: dict[str, tuple[Path, str]] = {}
        for file in files:
            name = f"demo_{_number(file)}"
            if name in found:
                raise DemonstrationsError(f"{file}: has the number of {found[name][0].name}; rename one")
            found[name] = (file, "/")
        return found

    def _read(self, name: str, group: h5py.Group) -> Recording:
        actions = _column(group, "action", name)
        if "base_action" in group:
            base = _column(group, "base_action", name)
            actions = of_array(joined({"action": actions.array(), "base_action": base.array()}, name))
        keys = datasets(member(group, "observations", h5py.Group, f"{name}: "))
        observations = {key: _column(group, f"observations/{key}", name) for key in keys}
        for key, column in observations.items():
            if key.startswith("images/") and column.dtype == np.uint8 and len(column.shape) == 2 and column.shape[0]:
                observations[key] = _decoded(column, f"{name}: observations/{key}")
        return Recording(name, observations, actions)


def _observed(group: h5py.Group, name: str) -> dict[str, str]:
    """Key and place of each observation of a ManiSkill trajectory."""
    if "obs" not in group:
        return {}
    obs = member(group, "obs", h5py.HLObject, f"{name}: ")
    return {BARE: "obs"} if isinstance(obs, h5py.Dataset) else {key: f"obs/{key}" for key in datasets(obs)}


def _number(file: Path) -> int:
    found = EPISODE.fullmatch(file.name)
    return int(found[1]) if found else 0


def _column(group: h5py.Group, key: str, name: str, part: slice = slice(None)) -> Column:
    """A part of a dataset; one number per step becomes a vector."""
    return as_vectors(of_dataset(dataset_at(group, key, f"{name}: " if name else ""), f"{name}: {key}", part))


def _decoded(column: Column, where: str) -> Column:
    """Encoded pictures [T, bytes] as uint8 [T, H, W, 3], in the encoded order of channels."""

    def decode(encoded: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        if picture is None or picture.shape != (shape or picture.shape):
            raise DemonstrationsError(f"{where}: a picture cannot be decoded, or is of another size than the first")
        return picture

    shape = decode(next(column.blocks())[0]).shape
    at_once = block_steps(shape, np.dtype(np.uint8))

    def blocks() -> Iterator[np.ndarray]:
        for block in column.blocks():
            for at in range(0, len(block), at_once):
                yield np.stack([decode(encoded, shape) for encoded in block[at : at + at_once]])

    return Column((column.shape[0], *shape), np.dtype(np.uint8), blocks)
