"""Minari datasets, read with the package minari (``pip install 'ddco-pyro[minari]'``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ddco_pyro.data.hdf5 import DAMAGE, Attribute, DemonstrationsError, dataset_at, datasets, member, opened
from ddco_pyro.data.sources.metadata import check_keys, check_links, first_missing
from ddco_pyro.data.sources.recording import Column, Format, Recording, damaged, of_array

BARE = "observation"
"""Key of an observation array without a name."""


class Minari:
    """Episodes of a dataset's folder. Nested observations ``{"arm": {"joints": ...}}`` become ``obs/arm/joints``.

    An episode of T steps has T + 1 observations; the observation after the last action is left out.
    """

    format: Format = "minari"
    frequency: float | None = None
    masks: Mapping[str, tuple[str, ...]] = {}

    def __init__(self, folder: Path, storage: Any, external: bool) -> None:
        self.folder, self._storage, self._external = folder, storage, external
        stored = _stored(folder)
        self._missing = first_missing(folder, storage.total_episodes, stored, "the dataset")
        self.names = tuple(f"demo_{index}" for index in sorted({*stored, *self._missing}))
        if not stored:
            raise DemonstrationsError(f"{folder}: holds no episodes; at least one is needed")
        self.attributes: Mapping[str, Attribute] = {"dataset_id": str(storage.metadata.get("dataset_id", ""))}
        self.files = tuple(sorted(path for path in folder.rglob("*") if path.is_file()))

    def recording(self, name: str) -> Recording:
        """One episode, in memory.

        :raises DemonstrationsError: the episode is missing, damaged or in another file, or its actions are not one
            array of numbers.
        """
        index = int(name.removeprefix("demo_"))
        if index in self._missing:
            raise DemonstrationsError(f"{self.folder}: {name} {self._missing[index]}")
        self._check_stored(index)
        try:
            (episode,) = self._storage.get_episodes([index])
            (facts,) = self._storage.get_episode_metadata([index])
        except (*DAMAGE, AssertionError) as error:
            raise damaged(self.folder, name, error) from error
        actions = episode["actions"]
        if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiu":
            what = actions.dtype if isinstance(actions, np.ndarray) else "several arrays"
            raise DemonstrationsError(
                f"{self.folder}: {name}: actions are {what}, they have to be one array of numbers"
            )
        steps, total = len(actions), facts.get("total_steps")
        if total is not None and total != steps:
            raise DemonstrationsError(f"{self.folder}: {name}: total_steps is {total}, and there are {steps} actions")
        leaves = list(_leaves(episode["observations"], ""))
        check_keys(self.folder, (key for key, _ in leaves))
        # an observation with another number of steps stays, and is refused later
        observations = {key: of_array(array[:-1] if len(array) == steps + 1 else array) for key, array in leaves}
        seed = facts.get("seed")
        known: dict[str, Attribute] = {"episode_index": index}
        if seed is not None:
            known["seed"] = int(seed)
        return Recording(name, observations, _rows(actions), {}, known)

    def _check_stored(self, index: int) -> None:
        """Refuse an episode in HDF5 whose arrays are not stored."""
        path = self.folder / "main_data.hdf5"
        if path.is_file():
            with opened(path) as file:
                episode = member(file, f"episode_{index}", h5py.Group, "", self._external)
                for key in datasets(episode, f"episode_{index}/", self._external):
                    if member(episode, key, h5py.Dataset, "", self._external).shape:
                        dataset_at(episode, key, f"episode_{index}/", self._external)


def _rows(actions: np.ndarray) -> Column:
    return of_array(actions.reshape(len(actions), -1))


def _leaves(observations: Any, key: str) -> Iterator[tuple[str, np.ndarray]]:
    """Path and array of each nested observation; text is left out."""
    if isinstance(observations, dict):
        for name, below in observations.items():
            yield from _leaves(below, f"{key}/{name}" if key else str(name))
    elif isinstance(observations, tuple):
        for number, below in enumerate(observations):
            yield from _leaves(below, f"{key}/{number}" if key else str(number))
    elif isinstance(observations, np.ndarray):
        yield key or BARE, observations if observations.ndim > 1 else observations[:, None]


def _stored(folder: Path) -> set[int]:
    """The numbers of the episodes: groups of an HDF5 file, or folders of Arrow files."""
    main = folder / "main_data.hdf5"
    if main.is_file():
        with opened(main) as file:
            names = [name.removeprefix("episode_") for name in file]
    else:
        names = [path.name for path in folder.iterdir() if path.is_dir()]
    return {int(name) for name in names if name.isdecimal()}


@contextmanager
def open_minari(path: Path, external: bool = False) -> Iterator[Minari]:
    """Open a dataset's folder, its folder ``data``, or the file ``main_data.hdf5``.

    :param external: whether parts of the HDF5 file may be in other files.
    :raises DemonstrationsError: Minari is not installed, or cannot read the dataset.
    """
    try:
        from minari.dataset.minari_storage import MinariStorage
    except ImportError:
        raise DemonstrationsError(
            "reading Minari datasets needs minari; install it with: pip install 'ddco-pyro[minari]'"
        ) from None
    folder = path.parent if path.is_file() else path / "data" if (path / "data").is_dir() else path
    check_links(folder)
    try:
        spaces = MinariStorage.read_raw_metadata(folder).keys() & {"observation_space", "action_space"}
        if len(spaces) < 2:  # Minari would make the environment, which runs code named by the data
            raise DemonstrationsError(f"{folder}: metadata.json does not say its observation and action spaces")
        storage = MinariStorage.read(folder)
    except (*DAMAGE, AssertionError, ImportError, AttributeError, RecursionError) as error:
        raise damaged(folder, "", error) from error
    yield Minari(folder, storage, external)
