"""Demonstrations in memory and in HDF5 files of robomimic's layout.

A file holds groups ``data/<name>`` with ``actions`` [T, A], ``obs/<key>`` [T, ...] and, if it likes, ``labels/<name>``
[T]; beside them, if it likes, ``mask/<name>``: lists of names of demonstrations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, overload

import h5py
import numpy as np

from ddco_pyro.data.files import whole_file
from ddco_pyro.data.hdf5 import (
    Attribute,
    DemonstrationsError,
    array_at,
    attributes_of,
    dataset_at,
    datasets,
    member,
    names_in_mask,
    natural,
    opened,
    written,
)
from ddco_pyro.data.memory import PROGRAM, Extent, refuse_too_much
from ddco_pyro.data.sources.recording import Recording, of_array
from ddco_pyro.data.values import LARGEST, usable
from ddco_pyro.errors import nearest


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One demonstration of T steps, s_0 a_0 ... s_{T-1} a_{T-1}.

    :param observations: key to [T, ...]; uint8 (images, HWC) stays as it is, other numbers become float64.
    :param actions: [T, A], the controls, float64.
    :param labels: name to [T], ground-truth segments, int64.
    :param attributes: what is known of the whole demonstration, such as its seed.
    :raises DemonstrationsError: no steps, unequal lengths, anything but numbers, or numbers that are NaN, infinite or
        beyond :data:`ddco_pyro.data.values.LARGEST`.
    """

    name: str
    observations: Mapping[str, np.ndarray]
    actions: np.ndarray
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.name or "/" in self.name:
            raise DemonstrationsError(
                f"{self.name!r} cannot be the name of a demonstration; it must not be empty or have a /"
            )
        actions = _numbers(self.actions, self.name, "actions")
        if actions.ndim != 2 or actions.shape[1] == 0:
            raise DemonstrationsError(
                f"{self.name}: actions has shape {actions.shape}, it has to be [steps, dimensions]"
            )
        if len(actions) == 0:
            raise DemonstrationsError(f"{self.name}: actions has no steps; remove this demonstration")
        observations = {key: _numbers(one, self.name, f"obs/{key}") for key, one in self.observations.items()}
        labels = {key: _integers(one, f"{self.name}: labels/{key}") for key, one in self.labels.items()}
        for where, array in [
            *((f"obs/{key}", one) for key, one in observations.items()),
            *((f"labels/{key}", one) for key, one in labels.items()),
        ]:
            if array.shape[:1] != (len(actions),):
                steps = f"{len(array)} steps" if array.ndim else "no steps"
                raise DemonstrationsError(f"{self.name}: {where} has {steps}, but actions has {len(actions)}")
        object.__setattr__(self, "actions", actions.astype(np.float64))
        object.__setattr__(self, "observations", observations)
        object.__setattr__(self, "labels", labels)

    def __len__(self) -> int:
        return len(self.actions)


def _numbers(array: Any, name: str, place: str) -> np.ndarray:
    """Numbers as float64, or as they are if uint8; everything finite and at most ``values.LARGEST``."""
    array, where = np.asarray(array), f"{name}: {place}"
    if array.dtype == np.uint8:
        return array
    if array.dtype.kind not in "fiub":
        raise DemonstrationsError(f"{where} holds {array.dtype}, it has to hold real numbers")
    good = usable(array)
    if not good.all():
        place = np.argwhere(~good)[0].tolist()
        value = float(array[tuple(place)])
        at = f" at step {place[0]}, index {place[1:]}" if place else ""
        limit = f", and at most {LARGEST:g} can be used" if np.isfinite(value) else ""
        raise DemonstrationsError(
            f"{where} is {value:g}{at}{limit}; repair it, or leave {name} out (demonstrations.exclude)"
        )
    return array.astype(np.float64)


def _integers(array: Any, where: str) -> np.ndarray:
    array = np.asarray(array)
    if array.dtype.kind not in "iub" or array.ndim != 1:
        raise DemonstrationsError(
            f"{where} is {array.dtype} of shape {array.shape}, it has to be integers of shape [steps]"
        )
    return array.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Demonstrations(Sequence[Demonstration]):
    """Demonstrations that go together: the same observations, of the same shapes, and controls of the same size.

    >>> demos = ddco_pyro.Demonstrations.read("mine.hdf5")
    >>> len(demos), demos.names[0], demos.observation_shapes, demos.control_size
    (6, 'demo_0', {'place': (2,)}, 2)
    >>> train, valid = demos.split(0.5, seed=0)
    >>> len(train), len(valid)
    (3, 3)

    :param masks: name to names of demonstrations, such as ``{"valid": ("demo_3", "demo_7")}``.
    :param attributes: what is known of all of them.
    :raises DemonstrationsError: none at all, a name given twice, they do not go together, a mask names an unknown one.
    """

    demonstrations: tuple[Demonstration, ...]
    masks: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.demonstrations:
            raise DemonstrationsError("there are no demonstrations; at least one is needed")
        if len(set(self.names)) < len(self):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise DemonstrationsError(f"{twice}: there are two demonstrations of this name; rename one")
        for demo in self.demonstrations[1:]:
            _check_alike(self.demonstrations[0], demo)
        for mask, names in self.masks.items():
            unknown = sorted(set(names) - set(self.names))
            if unknown:
                raise DemonstrationsError(f"mask/{mask}: {_unknown(unknown[0], self.names)}")

    @classmethod
    def read(
        cls,
        path: str | Path,
        observations: Sequence[str] | None = None,
        labels: Sequence[str] = (),
        exclude: Sequence[str] = (),
    ) -> Demonstrations:
        """The demonstrations in an HDF5 file, ``demo_2`` before ``demo_10``.

        :param observations: the keys to read; all of them if None.
        :param labels: names of the ground-truth labels to read.
        :param exclude: names of demonstrations that are left out, of masks too; nothing of them is read.
        :raises DemonstrationsError: the file cannot be read, does not hold what was asked for, or holds more than fits
            into memory.
        """
        with opened(path) as file:
            needed = PROGRAM + _extent(file, observations, labels, exclude).size
            refuse_too_much(needed, "reading it", "read only some observations, or scale pictures down")
            return cls(*_read(file, observations, labels, exclude))

    def write(self, path: str | Path) -> None:
        """Write an HDF5 file, whole or not at all."""
        with whole_file(Path(path)) as temporary, written(temporary) as file:
            file.attrs.update(self.attributes)
            data = file.create_group("data")
            data.attrs["total"] = sum(self.lengths)
            for demo in self:
                _write(data.create_group(demo.name), demo)
            for name, members in self.masks.items():
                file.create_dataset(f"mask/{name}", data=np.array([name.encode() for name in members], dtype=np.bytes_))

    def __len__(self) -> int:
        return len(self.demonstrations)

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Demonstration, ...]: ...
    def __getitem__(self, index: int | slice) -> Demonstration | tuple[Demonstration, ...]:
        return self.demonstrations[index]

    def __iter__(self) -> Iterator[Demonstration]:
        return iter(self.demonstrations)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names, in order."""
        return tuple(demo.name for demo in self.demonstrations)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Their numbers of steps."""
        return tuple(len(demo) for demo in self.demonstrations)

    @property
    def observation_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each observation at one step."""
        return {key: array.shape[1:] for key, array in self.demonstrations[0].observations.items()}

    @property
    def control_size(self) -> int:
        """A, the number of control dimensions."""
        return int(self.demonstrations[0].actions.shape[1])

    def select(self, names: Iterable[str]) -> Demonstrations:
        """The demonstrations of these names, in that order, without masks: those speak of the whole.

        :raises DemonstrationsError: there is none of that name.
        """
        by_name = {demo.name: demo for demo in self.demonstrations}
        chosen = tuple(names)
        for name in chosen:
            if name not in by_name:
                raise DemonstrationsError(_unknown(name, self.names))
        return Demonstrations(tuple(by_name[name] for name in chosen), attributes=self.attributes)

    def split(self, valid_fraction: float, seed: int) -> tuple[Demonstrations, Demonstrations]:
        """Training and validation demonstrations, at least one each.

        The masks ``train`` and ``valid`` decide if there are any; one of them alone leaves the rest to the other.
        Otherwise ``valid_fraction`` of the demonstrations are drawn with ``seed``.

        :raises DemonstrationsError: there is only one, a mask leaves nothing, or the masks overlap.
        """
        train, valid = self.masks.get("train"), self.masks.get("valid")
        if train is None and valid is None:
            valid = self._draw(valid_fraction, seed)
        train = self._without(valid or ()) if train is None else train
        valid = self._without(train) if valid is None else valid
        if not train or not valid:
            purpose = "validate" if train else "train"
            raise DemonstrationsError(f"no demonstration is left to {purpose} with; add some or change the masks")
        both = set(train) & set(valid)
        if both:
            raise DemonstrationsError(f"{min(both)} is in mask/train and in mask/valid; remove it from one")
        return self.select(train), self.select(valid)

    def _without(self, names: Iterable[str]) -> tuple[str, ...]:
        left_out = set(names)
        return tuple(name for name in self.names if name not in left_out)

    def _draw(self, fraction: float, seed: int) -> tuple[str, ...]:
        number = min(max(round(fraction * len(self)), 1), len(self) - 1)
        drawn = np.random.default_rng(seed).permutation(len(self))[:number]
        return tuple(self.names[index] for index in sorted(drawn))


def _check_alike(first: Demonstration, other: Demonstration) -> None:
    if other.actions.shape[1:] != first.actions.shape[1:]:
        raise DemonstrationsError(_differ(other, "actions", other.actions, first, first.actions))
    if set(other.observations) != set(first.observations) or set(other.labels) != set(first.labels):
        keys = sorted(set(other.observations) ^ set(first.observations) | set(other.labels) ^ set(first.labels))
        raise DemonstrationsError(f"{other.name}: {', '.join(keys)} is only in one of {first.name} and {other.name}")
    for key, array in other.observations.items():
        if array.shape[1:] != first.observations[key].shape[1:]:
            raise DemonstrationsError(_differ(other, f"obs/{key}", array, first, first.observations[key]))


def _differ(other: Demonstration, where: str, array: np.ndarray, first: Demonstration, expected: np.ndarray) -> str:
    return (
        f"{other.name}: {where} has shape {array.shape[1:]} at each step, but {expected.shape[1:]} in {first.name}; "
        "all demonstrations need the same"
    )


def _unknown(name: str, names: Sequence[str]) -> str:
    return f"there is no demonstration {name!r}{nearest(name, names)}"


# --- HDF5 -------------------------------------------------------------------------------------------------------------


def extent(path: str | Path, observations: Sequence[str], exclude: Sequence[str] = ()) -> Extent:
    """How much there is of these observations and of the controls, by the file's headers alone.

    :raises DemonstrationsError: the file cannot be read or does not hold them.
    """
    with opened(path) as file:
        return _extent(file, observations, (), exclude)


def _extent(
    file: h5py.File, observations: Sequence[str] | None, labels: Sequence[str], exclude: Sequence[str]
) -> Extent:
    return Extent.of(
        {
            "actions": dataset_at(group, "actions", f"{name}: "),
            **_datasets(group, "obs", observations, name),
            **_datasets(group, "labels", labels, name),
        }
        for name, group in _groups(file, exclude)
    )


def _datasets(group: h5py.Group, folder: str, keys: Sequence[str] | None, name: str) -> dict[str, h5py.Dataset]:
    """The datasets ``keys`` of a folder of a demonstration, by their place; all of them if None."""
    if keys is not None and not keys:
        return {}
    members = member(group, folder, h5py.Group, f"{name}: ")
    names = datasets(members) if keys is None else keys
    return {f"{folder}/{key}": dataset_at(members, key, f"{name}: {folder}/") for key in names}


def _groups(file: h5py.File, exclude: Sequence[str]) -> list[tuple[str, h5py.Group]]:
    """The demonstrations of a file with their names, in order, without those that are left out."""
    data = member(file, "data", h5py.Group, "")
    names = sorted((name for name in data if isinstance(data.get(name), h5py.Group)), key=natural)
    if not names:
        raise DemonstrationsError("the group 'data' holds no demonstrations; at least one is needed")
    for name in exclude:
        if name not in names:
            raise DemonstrationsError(f"demonstrations.exclude: {_unknown(name, names)}")
    if len(set(exclude)) == len(names):
        raise DemonstrationsError("demonstrations.exclude: leaves every demonstration out; keep some")
    return [(name, data[name]) for name in names if name not in exclude]


def _read(
    file: h5py.File, observations: Sequence[str] | None, labels: Sequence[str], exclude: Sequence[str]
) -> tuple[tuple[Demonstration, ...], dict[str, tuple[str, ...]], dict[str, Attribute]]:
    demonstrations = tuple(_read_one(group, name, observations, labels) for name, group in _groups(file, exclude))
    masks = member(file, "mask", h5py.Group, "") if "mask" in file else {}
    members = {mask: names_in_mask(masks, mask) for mask in masks}
    kept = {mask: tuple(name for name in names if name not in exclude) for mask, names in members.items()}
    return demonstrations, kept, attributes_of(file)


def _read_one(group: h5py.Group, name: str, observations: Sequence[str] | None, labels: Sequence[str]) -> Demonstration:
    actions = array_at(group, "actions", f"{name}: ")
    attributes = attributes_of(group)
    claimed = attributes.pop("num_samples", len(actions))
    if claimed != len(actions):
        raise DemonstrationsError(f"{name}: actions has {len(actions)} steps, but num_samples is {claimed}")
    return Demonstration(
        name=name,
        observations=_arrays(group, "obs", observations, name),
        actions=actions,
        labels=_arrays(group, "labels", labels, name),
        attributes=attributes,
    )


def _arrays(group: h5py.Group, folder: str, keys: Sequence[str] | None, name: str) -> dict[str, np.ndarray]:
    """The arrays ``keys`` of a folder of a demonstration; all of them if None."""
    if keys is not None and not keys:
        return {}
    members = member(group, folder, h5py.Group, f"{name}: ")
    return {key: array_at(members, key, f"{name}: {folder}/") for key in (datasets(members) if keys is None else keys)}


def _write(group: h5py.Group, demo: Demonstration) -> None:
    group.attrs.update(demo.attributes)
    group.attrs["num_samples"] = len(demo)
    group.create_dataset("actions", data=demo.actions)
    for key, array in demo.observations.items():
        group.create_dataset(f"obs/{key}", data=array)
    for key, array in demo.labels.items():
        group.create_dataset(f"labels/{key}", data=array)


def recording_of(demo: Demonstration) -> Recording:
    """A demonstration as a recording, to be written by itself."""
    return Recording(
        demo.name,
        {key: of_array(array) for key, array in demo.observations.items()},
        of_array(demo.actions),
        {key: of_array(array) for key, array in demo.labels.items()},
        demo.attributes,
    )
