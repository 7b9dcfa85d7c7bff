"""HDF5 files of robomimic's layout, which is also this project's: read, written, and written resumably.

A file holds groups ``data/<name>`` with ``actions`` [T, A], ``obs/<key>`` [T, ...] and optional ``labels/<name>`` [T].
Optional datasets ``mask/<name>`` list names of demonstrations (robomimic: filter keys).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import (
    Attribute,
    DemonstrationsError,
    attributes_of,
    dataset_at,
    datasets,
    member,
    named,
    natural,
    opened,
    written,
)
from ddco_pyro.data.sources.metadata import rate
from ddco_pyro.data.sources.recording import Column, Recording, of_dataset

ENVIRONMENT = "env_args"
"""Attribute of the group ``data``, where robomimic's tools look for it: the environment, as JSON."""

STEPS, ALL_STEPS = "num_samples", "total"
"""Attributes of a demonstration and of the group ``data``: number of steps."""

# --- reading ----------------------------------------------------------------------------------------------------------


class Robomimic:
    """An open file."""

    format = "robomimic"

    def __init__(self, path: Path, file: h5py.File) -> None:
        self._data = member(file, "data", h5py.Group, "")
        self.files = (path,)
        self.names = tuple(sorted((name for name in self._data if _may_be_group(self._data, name)), key=natural))
        if not self.names:
            raise DemonstrationsError("the group 'data' holds no demonstrations; at least one is needed")
        masks = member(file, "mask", h5py.Group, "") if named(file, "mask") else {}
        self.masks: Mapping[str, tuple[str, ...]] = {name: self._mask(masks, name) for name in masks}
        known = attributes_of(self._data) | attributes_of(file)
        self.attributes: Mapping[str, Attribute] = {name: known[name] for name in known if name != ALL_STEPS}
        self.frequency = frequency_of(self.attributes) or rate(self._first())

    def _first(self) -> Mapping[str, Attribute]:
        """The attributes of the first demonstration; none where it cannot be read."""
        try:
            return attributes_of(member(self._data, self.names[0], h5py.Group, ""))
        except DemonstrationsError:
            return {}

    def recording(
        self, name: str, observations: Sequence[str] | None = None, labels: Sequence[str] | None = None
    ) -> Recording:
        """One demonstration.

        :param observations: keys to open; all if None.
        :param labels: names to open; all if None, and then none are required.
        :raises DemonstrationsError: a part is missing, is elsewhere, or claims more than is stored.
        """
        group = member(self._data, name, h5py.Group, "")
        actions = self._column(group, "", "actions", name)
        attributes = attributes_of(group)
        claimed = attributes.pop(STEPS, actions.shape[0])
        if claimed != actions.shape[0]:
            raise DemonstrationsError(f"{name}: actions has {actions.shape[0]} steps, but {STEPS} is {claimed}")
        if labels is None and not named(group, "labels"):
            labels = ()
        seen = self._columns(group, "obs", observations, name)
        return Recording(name, seen, actions, self._columns(group, "labels", labels, name), attributes)

    def _columns(self, group: h5py.Group, folder: str, keys: Sequence[str] | None, name: str) -> dict[str, Column]:
        if keys is not None and not keys:
            return {}
        members = member(group, folder, h5py.Group, f"{name}: ")
        known = datasets(members, f"{name}: {folder}/") if keys is None else keys
        return {key: self._column(members, f"{folder}/", key, name) for key in known}

    def _column(self, group: h5py.Group, folder: str, key: str, name: str) -> Column:
        dataset = dataset_at(group, key, f"{name}: {folder}")
        return of_dataset(dataset, f"{name}: {folder}{key}")

    def _mask(self, masks: h5py.Group, mask: str) -> tuple[str, ...]:
        dataset = dataset_at(masks, mask, "mask/")
        names = of_dataset(dataset, f"mask/{mask}").array().ravel().tolist()
        return tuple(name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in names)


def _may_be_group(data: h5py.Group, name: str) -> bool:
    """Whether a name may be a demonstration; broken links are, and reading refuses them."""
    plain = isinstance(data.get(name, getlink=True), h5py.HardLink)
    try:
        return not plain or data.get(name, getclass=True) not in (h5py.Dataset, h5py.Datatype)
    except RuntimeError:
        return True


@contextmanager
def open_robomimic(path: Path) -> Iterator[Robomimic]:
    """Open a file.

    :raises DemonstrationsError: the file cannot be read, or holds no demonstrations.
    """
    with opened(path) as file:
        yield Robomimic(path, file)


# --- writing ----------------------------------------------------------------------------------------------------------


def frequency_of(attributes: Mapping[str, Attribute]) -> float | None:
    """Control steps per second, Hz, by the file's attributes or robomimic's description of the environment in them."""
    try:
        said = json.loads(str(attributes.get(ENVIRONMENT, "{}")))
        return rate(attributes) or rate({**said, **(said.get("env_kwargs") or {})})
    except (ValueError, TypeError, AttributeError, RecursionError):
        return rate(attributes)


@contextmanager
def robomimic_file(
    path: Path, attributes: Mapping[str, Attribute], masks: Mapping[str, Sequence[str]]
) -> Iterator[h5py.Group]:
    """The group ``data`` of a new file, for :func:`write_recording`; the file is written whole or not at all.

    ``attributes`` and ``masks`` are read at the end of the block.
    """
    with whole_file(path) as temporary, written(temporary) as file:
        data = file.create_group("data")
        yield data
        for name, value in attributes.items():
            (data if name == ENVIRONMENT else file).attrs[name] = value
        data.attrs[ALL_STEPS] = sum(len(group["actions"]) for group in data.values())
        for name, members in masks.items():
            file.create_dataset(f"mask/{name}", data=np.array([member.encode() for member in members], dtype=np.bytes_))


def write_recording(data: h5py.Group, recording: Recording) -> None:
    """Write a recording into a group of its own, block by block; pictures are compressed."""
    group = data.create_group(recording.name, track_order=True)
    group.attrs.update({**recording.attributes, STEPS: recording.actions.shape[0]})
    for place, column in recording.columns():
        chunks = {"chunks": (1, *column.shape[1:]), "compression": "gzip", "compression_opts": 1}
        dataset = group.create_dataset(
            place, column.shape, column.dtype, **(chunks if column.image and 0 not in column.shape else {})
        )
        at = 0
        for block in column.blocks():
            dataset[at : at + len(block)] = block
            at += len(block)
