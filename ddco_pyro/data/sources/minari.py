"""Minari datasets, read with the package minari (``pip install 'ddco-pyro[minari]'``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ddco_pyro.data.hdf5 import DAMAGE, Attribute, DemonstrationsError, dataset_at, datasets, member, opened
from ddco_pyro.data.sources.metadata import check_links, first_missing, stored_keys
from ddco_pyro.data.sources.recording import Recording, damaged, joined
from ddco_pyro.errors import nearest

BARE = "observation"
"""Key of an observation array without a name."""


class Minari:
    """Episodes of a dataset's folder. Nested observations ``{"arm": {"joints": ...}}`` become ``obs/arm/joints``.

    Nested actions are joined, in the order of the action space. An episode of T steps has T + 1 observations; the
    observation after the last action is left out.

    :param actions: names of nested actions that are the control together, such as ``arm/joints``; all if empty.
    """

    format = "minari"
    frequency: float | None = None
    masks: Mapping[str, tuple[str, ...]] = {}

    def __init__(self, folder: Path, storage: Any, actions: Sequence[str]) -> None:
        self.folder, self._storage, self._actions = folder, storage, actions
        stored = _stored(folder)
        self._missing = first_missing(folder, storage.total_episodes, stored, "the dataset")
        self.names = tuple(f"demo_{index}" for index in sorted({*stored, *self._missing}))
        if not stored:
            raise DemonstrationsError(f"{folder}: holds no episodes; at least one is needed")
        self.attributes: Mapping[str, Attribute] = {"dataset_id": str(storage.metadata.get("dataset_id", ""))}
        self.files = tuple(sorted(path for path in folder.rglob("*") if path.is_file()))

    def recording(self, name: str) -> Recording:
        """One episode, in memory.

        :raises DemonstrationsError: the episode is missing, damaged or in another file, or its actions are no numbers.
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
        actions = self._control(episode["actions"], f"{self.folder}: {name}")
        steps, total = len(actions), facts.get("total_steps")
        if total is not None and total != steps:
            raise DemonstrationsError(f"{self.folder}: {name}: total_steps is {total}, and there are {steps} actions")
        # an observation with another number of steps stays, and is refused later
        observations = {
            key: array[:-1] if len(array) == steps + 1 else array
            for key, array in self._flat(episode["observations"], BARE).items()
        }
        seed = facts.get("seed")
        known: dict[str, Attribute] = {"episode_index": index}
        if seed is not None:
            known["seed"] = int(seed)
        return Recording.of(name, observations, actions, {}, known)

    def _control(self, actions: Any, where: str) -> np.ndarray:
        """The chosen actions [T, A] of an episode."""
        parts = self._flat(actions, "actions")
        for key in self._actions:
            if key not in parts:
                raise DemonstrationsError(
                    f"{where}: there is no action {key!r}{nearest(key, parts)}; there is: {', '.join(parts)}"
                )
        return joined({key: parts[key] for key in self._actions or parts}, where)

    def _flat(self, nested: Any, bare: str) -> dict[str, np.ndarray]:
        """Each array by its key; ``bare`` is the key of an array that is not nested."""
        leaves = list(_leaves(nested, "", bare))
        names = [name for name, _ in leaves]
        return dict(zip(stored_keys(self.folder, names, names), (array for _, array in leaves), strict=True))

    def _check_stored(self, index: int) -> None:
        """Refuse an episode in HDF5 whose arrays are not stored."""
        path = self.folder / "main_data.hdf5"
        if path.is_file():
            with opened(path) as file:
                episode = member(file, f"episode_{index}", h5py.Group, "")
                for key in datasets(episode, f"episode_{index}/"):
                    if member(episode, key, h5py.Dataset, "").shape:
                        dataset_at(episode, key, f"episode_{index}/")


def _leaves(nested: Any, key: str, bare: str) -> Iterator[tuple[str, np.ndarray]]:
    """Path and array of each nested observation or action; ``bare`` is the path of an array that is not nested."""
    if isinstance(nested, dict):
        for name, below in nested.items():
            yield from _leaves(below, f"{key}/{name}" if key else str(name), bare)
    elif isinstance(nested, tuple):
        for number, below in enumerate(nested):
            yield from _leaves(below, f"{key}/{number}" if key else str(number), bare)
    else:
        array = np.asarray(nested)  # a list of text
        yield key or bare, array[:, None] if array.ndim == 1 else array


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
def open_minari(path: Path, actions: Sequence[str] = ()) -> Iterator[Minari]:
    """Open a dataset's folder, its folder ``data``, or the file ``main_data.hdf5``.

    :param actions: names of nested actions that are the control together; all if empty.
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
    yield Minari(folder, storage, actions)
