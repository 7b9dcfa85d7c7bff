"""HDF5 files of robomimic's layout, which is this project's own too."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import h5py

from ddco_pyro.data.hdf5 import (
    Attribute,
    DemonstrationsError,
    attributes_of,
    dataset_at,
    datasets,
    member,
    names_in_mask,
    natural,
    opened,
)
from ddco_pyro.data.sources.recording import Column, Format, Recording, of_dataset

FREQUENCY = "control_frequency"
"""Attribute of a file: control steps in a second, Hz."""


class Robomimic:
    """Groups ``data/<name>`` with ``actions``, ``obs/<key>`` and perhaps ``labels/<name>``; ``mask/<name>``."""

    format: Format = "robomimic"

    def __init__(self, path: Path, file: h5py.File) -> None:
        self._data = member(file, "data", h5py.Group, "")
        self.files = (path,)
        self.names = tuple(
            sorted((name for name in self._data if isinstance(self._data.get(name), h5py.Group)), key=natural)
        )
        if not self.names:
            raise DemonstrationsError("the group 'data' holds no demonstrations; at least one is needed")
        masks = member(file, "mask", h5py.Group, "") if "mask" in file else {}
        self.masks: Mapping[str, tuple[str, ...]] = {name: names_in_mask(masks, name) for name in masks}
        self.attributes: Mapping[str, Attribute] = attributes_of(self._data) | attributes_of(file)
        self.frequency = _frequency(self.attributes)

    def recording(self, name: str) -> Recording:
        """One demonstration.

        :raises DemonstrationsError: it has no actions or no observations, or claims more than the file holds.
        """
        group = member(self._data, name, h5py.Group, "")
        actions = dataset_at(group, "actions", f"{name}: ")
        return Recording(
            name,
            _columns(group, "obs", name),
            of_dataset(actions, f"{name}: actions"),
            _columns(group, "labels", name) if "labels" in group else {},
            attributes_of(group),
        )


def _columns(group: h5py.Group, folder: str, name: str) -> dict[str, Column]:
    members = member(group, folder, h5py.Group, f"{name}: ")
    return {
        key: of_dataset(dataset_at(members, key, f"{name}: {folder}/"), f"{name}: {folder}/{key}")
        for key in datasets(members)
    }


def _frequency(attributes: Mapping[str, Attribute]) -> float | None:
    """Said by the file itself, or by the environment that robomimic keeps as JSON in ``env_args``."""
    own = attributes.get(FREQUENCY)
    if own is None:
        try:
            own = json.loads(str(attributes.get("env_args", "{}")))["env_kwargs"]["control_freq"]
        except (ValueError, TypeError, KeyError, RecursionError):
            return None
    return float(own) if isinstance(own, int | float) and own > 0 else None


@contextmanager
def open_robomimic(path: Path) -> Iterator[Robomimic]:
    """Open such a file.

    :raises DemonstrationsError: it cannot be read or holds no demonstrations.
    """
    with opened(path) as file:
        yield Robomimic(path, file)
