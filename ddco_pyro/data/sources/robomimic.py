"""HDF5 files of robomimic's layout, which is also this project's: read and written.

A file holds groups ``data/<name>`` with ``actions`` [T, A], ``obs/<key>`` [T, ...] and optional
``labels/<name>`` [T]. Optional datasets ``mask/<name>`` list names of demonstrations (robomimic: filter
keys). Signals of subtasks, such as MimicGen's and Isaac Lab's, are read as ``labels/subtask``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py
import numpy as np

from ddco_pyro.data.arrays import blocks, is_picture
from ddco_pyro.data.demonstration import Attribute, Demonstration
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import (
    attributes_of,
    dataset_at,
    datasets,
    lazy,
    member,
    natural,
    opened,
    values_of,
    written,
)
from ddco_pyro.data.labels import LABEL_NAMES, label_names
from ddco_pyro.data.sources import Source
from ddco_pyro.data.sources.metadata import rate

ENVIRONMENT = "env_args"
"""Attribute of the group ``data``, where robomimic's tools look for it: the environment, as JSON."""

STEPS, ALL_STEPS = "num_samples", "total"
"""Attributes of a demonstration and of the group ``data``: number of steps."""

SUBTASK = "subtask"
"""Labels that are made of signals, where the file has none of this name."""

SIGNALS = ("datagen_info/subtask_term_signals", "obs/datagen_info/subtask_term_signals")
"""Where MimicGen and Isaac Lab have each subtask's signal: 1 from its last step on. What follows has none."""

# --- reading ------------------------------------------------------------------------------------------------


def open_robomimic(path: Path) -> Iterator[Source]:
    """Open a file. Its source's ``read`` also takes keys of observations and names of labels; all if None.

    :raises DemonstrationsError: the file cannot be read.
    """
    with opened(path) as file:
        data = member(file, "data", h5py.Group, "")
        names = tuple(sorted((name for name in data if _may_be_group(data, name)), key=natural))
        masks = member(file, "mask", h5py.Group, "") if "mask" in file else {}
        known = attributes_of(data) | attributes_of(file)
        attributes = {name: known[name] for name in known if name != ALL_STEPS}
        frequency, order = frequency_of(attributes), list[str]()
        if names:
            with suppress(DemonstrationsError):  # reading it tells
                first = member(data, names[0], h5py.Group, "")
                frequency = frequency or rate(attributes_of(first))
                if order := list(_ends(first, names[0])):
                    named = {SUBTASK: [*order, "last"], **label_names(attributes)}
                    attributes[LABEL_NAMES] = json.dumps(named)

        def read(
            name: str, observations: Sequence[str] | None = None, labels: Sequence[str] | None = None
        ) -> Demonstration:
            return _read(member(data, name, h5py.Group, ""), name, observations, labels, order)

        yield Source(names, read, {name: _mask(masks, name) for name in masks}, frequency, attributes)


def _ends(group: h5py.Group, name: str) -> dict[str, int]:
    """The last step of each subtask by name, the first one first; the number of steps if it never ends.

    Empty without signals, and where the demonstration has labels of this name.
    """
    place = next((place for place in SIGNALS if place in group), None)
    if place is None or f"labels/{SUBTASK}" in group:
        return {}
    members, where = member(group, place, h5py.Group, f"{name}: "), f"{name}: {place}/"
    keys = datasets(members, where)
    signals = {key: values_of(dataset_at(members, key, where), where + key) for key in keys}
    ends = {key: int(np.append(values.ravel() > 0, True).argmax()) for key, values in signals.items()}
    return dict(sorted(ends.items(), key=lambda item: item[1]))


def _subtasks(ends: Mapping[str, int], order: Sequence[str], steps: int) -> np.ndarray:
    """The subtask of each step [T]: the place in ``order`` of the one that ends next; behind all the last."""
    labels, before = np.full(steps, len(order), np.int16), 0
    for name, end in ends.items():
        if end < steps and name in order:
            labels[before : end + 1], before = order.index(name), end + 1
    return labels


def _read(
    group: h5py.Group,
    name: str,
    observations: Sequence[str] | None,
    labels: Sequence[str] | None,
    order: Sequence[str] = (),
) -> Demonstration:
    """A demonstration.

    :param order: the names of labels/subtask that signals become; empty where the file has no signals.
    :raises DemonstrationsError: a part is missing, is elsewhere, or claims more than is stored.
    """

    def found(folder: str, keys: Sequence[str] | None) -> dict[str, h5py.Dataset]:
        if keys is not None and not keys:
            return {}
        members = member(group, folder, h5py.Group, f"{name}: ")
        known = datasets(members, f"{name}: {folder}/") if keys is None else keys
        return {key: dataset_at(members, key, f"{name}: {folder}/") for key in known}

    control, attributes = dataset_at(group, "actions", f"{name}: "), attributes_of(group)
    claimed = attributes.pop(STEPS, len(control))
    if claimed != len(control):
        raise DemonstrationsError(f"{name}: actions has {len(control)} steps, but {STEPS} is {claimed}")
    ends = _ends(group, name) if order and (labels is None or SUBTASK in labels) else {}
    signalled = {SUBTASK: _subtasks(ends, order, len(control))} if ends else {}
    if labels is None and group.get("labels", getlink=True) is None:
        labels = ()
    labels = labels and [key for key in labels if key not in signalled]
    seen = {key: lazy(dataset, f"{name}: obs/{key}") for key, dataset in found("obs", observations).items()}
    labelled = found("labels", labels).items()
    known = {key: values_of(dataset, f"{name}: labels/{key}") for key, dataset in labelled} | signalled
    return Demonstration.stored(name, seen, values_of(control, f"{name}: actions"), known, attributes)


def _mask(masks: h5py.Group, mask: str) -> tuple[str, ...]:
    names = values_of(dataset_at(masks, mask, "mask/"), f"mask/{mask}").ravel().tolist()
    return tuple(name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in names)


def _may_be_group(data: h5py.Group, name: str) -> bool:
    """Whether a name may be a demonstration; broken links are, and reading refuses them."""
    plain = isinstance(data.get(name, getlink=True), h5py.HardLink)
    try:
        return not plain or data.get(name, getclass=True) not in (h5py.Dataset, h5py.Datatype)
    except RuntimeError:
        return True


def frequency_of(attributes: Mapping[str, Attribute]) -> float | None:
    """Control steps per second, Hz, by the file's attributes or robomimic's environment described in them."""
    try:
        said = json.loads(str(attributes.get(ENVIRONMENT, "{}")))
        return rate(attributes) or rate({**said, **(said.get("env_kwargs") or {})})
    except (ValueError, TypeError, AttributeError, RecursionError):
        return rate(attributes)


# --- writing ------------------------------------------------------------------------------------------------


@contextmanager
def robomimic_file(
    path: Path, attributes: Mapping[str, Attribute], masks: Mapping[str, Sequence[str]]
) -> Iterator[h5py.Group]:
    """The group ``data`` of a new file, for :func:`write_demonstration`; it is written whole or not at all.

    ``attributes`` and ``masks`` are read at the end of the block.
    """
    with whole_file(path) as temporary, written(temporary) as file:
        data = file.create_group("data")
        yield data
        for name, value in attributes.items():
            (data if name == ENVIRONMENT else file).attrs[name] = value
        data.attrs[ALL_STEPS] = sum(len(group["actions"]) for group in data.values())
        for name, members in masks.items():
            encoded = np.array([member.encode() for member in members], dtype=np.bytes_)
            file.create_dataset(f"mask/{name}", data=encoded)


def write_demonstration(data: h5py.Group, demo: Demonstration) -> None:
    """Write a demonstration into a group of its own, block by block; pictures are compressed."""
    group = data.create_group(demo.name, track_order=True)
    group.attrs.update({**demo.attributes, STEPS: len(demo)})
    for place, array in demo.arrays().items():
        how = {"chunks": (1, *array.shape[1:]), "compression": "gzip", "compression_opts": 1}
        packed = is_picture(array) and 0 not in array.shape
        dataset, at = group.create_dataset(place, array.shape, array.dtype, **(how if packed else {})), 0
        for block in blocks(array):
            dataset[at : at + len(block)] = block
            at += len(block)
