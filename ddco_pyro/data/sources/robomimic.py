"""HDF5 files of robomimic's layout, which is this project's own too: read and written here, and nowhere else.

A file holds groups ``data/<name>`` with ``actions`` [T, A], ``obs/<key>`` [T, ...] and perhaps ``labels/<name>`` [T];
beside them perhaps ``mask/<name>``: lists of names of demonstrations (robomimic: filter keys).
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
from ddco_pyro.data.sources.recording import Column, Format, Recording, of_dataset

FREQUENCY = "control_frequency"
"""Attribute of a file: control steps in a second, Hz."""

ENVIRONMENT = "env_args"
"""Attribute of the group ``data``, where robomimic's own tools look for it: the environment, as JSON."""

STEPS, ALL_STEPS = "num_samples", "total"
"""Attributes of a demonstration and of the group ``data``: the number of steps."""


class Robomimic:
    """An open file."""

    format: Format = "robomimic"

    def __init__(self, path: Path, file: h5py.File, external: bool = False) -> None:
        self._external = external
        self._data = member(file, "data", h5py.Group, "", external)
        self.files = (path,)
        self.names = tuple(sorted((name for name in self._data if _may_be_group(self._data, name)), key=natural))
        if not self.names:
            raise DemonstrationsError("the group 'data' holds no demonstrations; at least one is needed")
        masks = member(file, "mask", h5py.Group, "", external) if named(file, "mask") else {}
        self.masks: Mapping[str, tuple[str, ...]] = {name: self._mask(masks, name) for name in masks}
        said = attributes_of(self._data) | attributes_of(file)
        self.attributes: Mapping[str, Attribute] = {name: said[name] for name in said if name != ALL_STEPS}
        self.frequency = _frequency(self.attributes)

    def recording(
        self, name: str, observations: Sequence[str] | None = None, labels: Sequence[str] | None = None
    ) -> Recording:
        """One demonstration.

        :param observations: the keys to open; all of them if None. Likewise ``labels``, which need not be there then.
        :raises DemonstrationsError: something of it is missing, lies in another file, or claims more than is stored.
        """
        group = member(self._data, name, h5py.Group, "", self._external)
        actions = self._column(group, "", "actions", name)
        attributes = attributes_of(group)
        claimed = attributes.pop(STEPS, actions.shape[0])
        if claimed != actions.shape[0]:
            raise DemonstrationsError(f"{name}: actions has {actions.shape[0]} steps, but {STEPS} is {claimed}")
        if labels is None and not named(group, "labels"):
            labels = ()
        return Recording(
            name,
            self._columns(group, "obs", observations, name),
            actions,
            self._columns(group, "labels", labels, name),
            attributes,
        )

    def _columns(self, group: h5py.Group, folder: str, keys: Sequence[str] | None, name: str) -> dict[str, Column]:
        """The arrays ``keys`` of a folder of a demonstration; all of them if None."""
        if keys is not None and not keys:
            return {}
        members = member(group, folder, h5py.Group, f"{name}: ", self._external)
        known = datasets(members, f"{name}: {folder}/", self._external) if keys is None else keys
        return {key: self._column(members, f"{folder}/", key, name) for key in known}

    def _column(self, group: h5py.Group, folder: str, key: str, name: str) -> Column:
        dataset = dataset_at(group, key, f"{name}: {folder}", self._external)
        return of_dataset(dataset, f"{name}: {folder}{key}")

    def _mask(self, masks: h5py.Group, mask: str) -> tuple[str, ...]:
        """The names of demonstrations that a mask lists."""
        dataset = dataset_at(masks, mask, "mask/", self._external)
        names = of_dataset(dataset, f"mask/{mask}").array().ravel().tolist()
        return tuple(name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in names)


def _may_be_group(data: h5py.Group, name: str) -> bool:
    """Whether a name stands for a demonstration; a link that leads nowhere does, and is refused when it is read."""
    plain = isinstance(data.get(name, getlink=True), h5py.HardLink)
    try:
        return not plain or data.get(name, getclass=True) not in (h5py.Dataset, h5py.Datatype)
    except RuntimeError:
        return True


def _frequency(attributes: Mapping[str, Attribute]) -> float | None:
    """Said by the file itself, or by the environment that robomimic keeps."""
    own = attributes.get(FREQUENCY)
    if own is None:
        try:
            own = json.loads(str(attributes.get(ENVIRONMENT, "{}")))["env_kwargs"]["control_freq"]
        except (ValueError, TypeError, KeyError, RecursionError):
            return None
    return float(own) if isinstance(own, int | float) and own > 0 else None


@contextmanager
def open_robomimic(path: Path, external: bool = False) -> Iterator[Robomimic]:
    """Open such a file.

    :param external: whether parts of it may lie in other files.
    :raises DemonstrationsError: it cannot be read or holds no demonstrations.
    """
    with opened(path) as file:
        yield Robomimic(path, file, external)


@contextmanager
def robomimic_file(
    path: Path, attributes: Mapping[str, Attribute], masks: Mapping[str, Sequence[str]]
) -> Iterator[h5py.Group]:
    """The group ``data`` of a new file, to be filled by :func:`write_recording`; written whole or not at all."""
    with whole_file(path) as temporary, written(temporary) as file:
        data = file.create_group("data")
        yield data
        for name, value in attributes.items():
            (data if name == ENVIRONMENT else file).attrs[name] = value
        data.attrs[ALL_STEPS] = sum(len(group["actions"]) for group in data.values())
        for name, members in masks.items():
            file.create_dataset(f"mask/{name}", data=np.array([member.encode() for member in members], dtype=np.bytes_))


def write_recording(data: h5py.Group, recording: Recording) -> None:
    """Write a recording as a group of its own, block by block; its attributes keep their order."""
    group = data.create_group(recording.name, track_order=True)
    group.attrs.update({**recording.attributes, STEPS: recording.actions.shape[0]})
    for place, column in recording.columns():
        _write(group, place, column)


def _write(group: h5py.Group, place: str, column: Column) -> None:
    """Write an array block by block; pictures are compressed."""
    settings = {"chunks": (1, *column.shape[1:]), "compression": "gzip", "compression_opts": 1} if column.image else {}
    dataset = group.create_dataset(place, column.shape, column.dtype, **settings)
    at = 0
    for block in column.blocks():
        dataset[at : at + len(block)] = block
        at += len(block)
