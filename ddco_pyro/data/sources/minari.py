"""Minari datasets, read with the package minari (``pip install 'ddco-pyro[minari]'``)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ddco_pyro.data.demonstration import Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError, reading
from ddco_pyro.data.hdf5 import dataset_at, datasets, member, opened
from ddco_pyro.data.sources import Source
from ddco_pyro.data.sources.metadata import check_count, joined, stored_keys
from ddco_pyro.errors import needing, refuse_unknown

BARE = "observation"
"""Key of an observation array without a name."""

MAIN = "main_data.hdf5"


def open_minari(path: Path, actions: Sequence[str] = ()) -> Iterator[Source]:
    """Open a dataset's folder, its folder ``data``, or the file ``main_data.hdf5``.

    Nested observations ``{"arm": {"joints": ...}}`` become ``obs/arm/joints``. Nested actions are joined, in
    the order of the action space. Of the T + 1 observations of an episode of T steps the last is left out.

    :param actions: names of nested actions that are the control, such as ``arm/joints``; all if empty.
    :raises DemonstrationsError: Minari is not installed, or cannot read the dataset.
    """
    with needing("minari", "reading Minari datasets"):
        from minari.dataset.minari_storage import MinariStorage
    folder = path.parent if path.is_file() else path / "data" if (path / "data").is_dir() else path
    with reading(folder):
        spaces = MinariStorage.read_raw_metadata(folder).keys() & {"observation_space", "action_space"}
        if len(spaces) < 2:  # Minari would make the environment, which runs code named by the data
            lacks = "metadata.json does not say its observation and action spaces"
            raise DemonstrationsError(f"{folder}: {lacks}")
        storage = MinariStorage.read(folder)
    stored = _episodes(folder)
    if stored:
        check_count(folder, storage.total_episodes, len(stored), "the dataset")

    def read(name: str) -> Demonstration:
        index, where = int(name.removeprefix("demo_")), f"{folder}: {name}"
        if (folder / MAIN).is_file():
            with opened(folder / MAIN) as file:
                group = member(file, f"episode_{index}", h5py.Group, "")
                for key in datasets(group):
                    dataset_at(group, key, f"{name}: ")  # values never stored would be read as zeros
        with reading(folder, name):
            (episode,) = storage.get_episodes([index])
            (facts,) = storage.get_episode_metadata([index])
        control = _control(folder, episode["actions"], actions, where)
        if (total := facts.get("total_steps")) not in (None, len(control)):
            differ = f"total_steps is {total}, and there are {len(control)} actions"
            raise DemonstrationsError(f"{where}: {differ}")
        seen = _flat(folder, episode["observations"], BARE)
        after = len(control) + 1  # with another number of steps it stays, and is refused later
        observations = {key: array[:-1] if len(array) == after else array for key, array in seen.items()}
        seed: dict[str, Attribute] = {} if facts.get("seed") is None else {"seed": int(facts["seed"])}
        return Demonstration.stored(name, observations, control, {}, {"episode_index": index, **seed})

    names = tuple(f"demo_{index}" for index in sorted(stored))
    yield Source(names, read, attributes={"dataset_id": str(storage.metadata.get("dataset_id", ""))})


def _control(folder: Path, nested: Any, chosen: Sequence[str], where: str) -> np.ndarray:
    """The chosen actions [T, A] of an episode."""
    parts = _flat(folder, nested, "actions")
    for key in chosen:
        refuse_unknown("action", key, parts, DemonstrationsError, f"{where}: ")
    return joined({key: parts[key] for key in chosen or parts}, where)


def _flat(folder: Path, nested: Any, bare: str) -> dict[str, np.ndarray]:
    """Each array by its key; ``bare`` is the key of an array that is not nested."""
    leaves = list(_leaves(nested, "", bare))
    names = [name for name, _ in leaves]
    return dict(zip(stored_keys(folder, names, names), (array for _, array in leaves), strict=True))


def _leaves(nested: Any, key: str, bare: str) -> Iterator[tuple[str, np.ndarray]]:
    """Path and array of each nested observation or action; ``bare`` is the path of an array not nested."""
    if isinstance(nested, Mapping | tuple):
        for name, below in nested.items() if isinstance(nested, Mapping) else enumerate(nested):
            yield from _leaves(below, f"{key}/{name}" if key else str(name), bare)
    else:
        array = np.asarray(nested)  # a list of text
        yield key or bare, array[:, None] if array.ndim == 1 else array


def _episodes(folder: Path) -> set[int]:
    """The numbers of the episodes: groups of an HDF5 file, or folders of Arrow files."""
    main = folder / MAIN
    if main.is_file():
        with opened(main) as file:
            names = [name.removeprefix("episode_") for name in file]
    else:
        names = [path.name for path in folder.iterdir() if path.is_dir()]
    return {int(name) for name in names if name.isdecimal()}
