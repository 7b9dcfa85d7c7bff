"""Demonstrations ready for a fit: alike, in memory except pictures in files; read, written and divided."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import overload

import numpy as np

from ddco_pyro.data.arrays import refuse_too_much
from ddco_pyro.data.demonstration import NOTHING, Attribute, Demonstration, check, needed
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.labels import LABEL_NAMES, label_names
from ddco_pyro.data.sources import open_own
from ddco_pyro.data.sources.robomimic import frequency_of, robomimic_file, write_demonstration
from ddco_pyro.data.tasks import NAMES, TASKS, Known, Where, by_task, by_value, of_tasks, task_of, with_task
from ddco_pyro.errors import check_whole, nearest, path_of

Masks = Mapping[str, Sequence[str]]
LEAST = 3
"""Fewest demonstrations for a fit: to train, to stop early, and to validate."""

FEW = 8
"""Of fewer demonstrations none is held out from the fit: parts to tune by and to validate leave too few."""


@dataclass(frozen=True, eq=False, repr=False)
class Demonstrations(Sequence[Demonstration]):
    """Demonstrations with the same observations, of the same shapes, and controls of the same size.

    >>> demos = ddco_pyro.Demonstrations.read("mine.hdf5")
    >>> len(demos), demos.names[0], demos.observation_shapes, demos.control_size
    (6, 'demo_0', {'place': (2,)}, 2)
    >>> train, valid = demos.split(0.5, seed=0)
    >>> len(train), len(valid)
    (3, 3)

    :param masks: name to names of demonstrations, such as ``{"valid": ("demo_3", "demo_7")}``.
    :param attributes: facts about all of them.
    :raises DemonstrationsError: there are none, a name occurs twice, their arrays differ, or a mask names an
        unknown demonstration.
    """

    demonstrations: tuple[Demonstration, ...]
    masks: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for demo in self.demonstrations:
            if not isinstance(demo, Demonstration):
                raise not_demonstrations(demo)
        if not self.demonstrations:
            raise DemonstrationsError("there are no demonstrations; at least one is needed")
        if len(set(self.names)) < len(self):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise DemonstrationsError(f"{twice}: there are two demonstrations of this name; rename one")
        for demo in self.demonstrations[1:]:
            check(demo, self.demonstrations[0])
        for problem in problems_of_masks(self.masks, self.names):
            raise DemonstrationsError(problem)

    @classmethod
    def read(
        cls,
        path: str | Path,
        observations: Sequence[str] | None = None,
        labels: Sequence[str] | None = None,
        exclude: Sequence[str] = (),
        where: Where = NOTHING,
    ) -> Demonstrations:
        """The demonstrations in an HDF5 file, ``demo_2`` before ``demo_10``.

        :param observations: keys to read; all if None, and none if empty.
        :param labels: names of the ground-truth labels to read; likewise.
        :param exclude: names of demonstrations that are not read and are removed from masks.
        :param where: attributes and values, such as ``{"task": ["reach"]}``: others are not read either.
        :raises DemonstrationsError: the file is unreadable, lacks what is asked for, or exceeds memory.
        """
        whole = path_of(path, "demonstrations")
        with open_own(whole, where, exclude) as source:
            found = [source.read(name, observations, labels) for name in source.names]
            remedy = "read only some observations, or scale pictures down"
            refuse_too_much(needed(found, copies=0), "reading it", remedy)
            read = tuple(Demonstration(**vars(demo)) for demo in found)
            return cls(read, source.masks, source.attributes)

    def write(self, path: str | Path) -> None:
        """Write an HDF5 file, whole or not at all."""
        with robomimic_file(Path(path), self.attributes, self.masks) as data:
            for demo in self:
                write_demonstration(data, demo)

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

    def __repr__(self) -> str:
        fewest, most = min(self.lengths), max(self.lengths)
        steps = f"{most}" if fewest == most else f"{fewest} to {most}"
        masks = "".join(f"\n  mask/{mask}: {len(members)}" for mask, members in self.masks.items())
        return f"{len(self)} demonstrations of {steps} steps{self[0].shapes}{masks}"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the demonstrations, in order."""
        return tuple(demo.name for demo in self.demonstrations)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Number of steps of each demonstration."""
        return tuple(len(demo) for demo in self.demonstrations)

    @property
    def observation_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each observation at one step."""
        return {key: array.shape[1:] for key, array in self.demonstrations[0].observations.items()}

    @property
    def control_size(self) -> int:
        """A, the number of control dimensions."""
        return int(self.demonstrations[0].actions.shape[1])

    @property
    def tasks(self) -> tuple[str, ...]:
        """The task of each demonstration, in order; empty texts where none is named."""
        return tuple(task_of(demo.attributes) for demo in self.demonstrations)

    @property
    def frequency(self) -> float | None:
        """Control steps per second, Hz; None if unknown."""
        return frequency_of(self.attributes)

    def select(self, names: Iterable[str]) -> Demonstrations:
        """The demonstrations of these names, in this order, without masks.

        :raises DemonstrationsError: a name is unknown.
        """
        by_name = {demo.name: demo for demo in self.demonstrations}
        chosen = tuple(names)
        for name in chosen:
            if name not in by_name:
                raise DemonstrationsError(unknown(name, self.names))
        return Demonstrations(tuple(by_name[name] for name in chosen), attributes=self.attributes)

    def split(self, valid_fraction: float, seed: int) -> tuple[Demonstrations, Demonstrations]:
        """Training and validation demonstrations, at least one each.

        The split follows the masks ``train`` and ``valid``; one mask leaves the rest to the other. Without
        these masks, ``valid_fraction`` of each task's demonstrations are drawn with ``seed`` to validate.

        :raises DemonstrationsError: a part is empty, masks overlap, or the fraction is not from 0 to below 1.
        """
        check_whole("seed", seed)
        if not isinstance(valid_fraction, Real) or not 0 <= valid_fraction < 1:
            wanted = "has to be a number from 0 to below 1"
            raise DemonstrationsError(f"valid_fraction={valid_fraction!r}: {wanted}")
        masks = self.masks
        if not masks.keys() & {"train", "valid"}:
            masks = {"valid": drawn({demo.name: demo.attributes for demo in self}, valid_fraction, seed)}
        train, valid = split_by_masks(self.names, masks)
        return self.select(train), self.select(valid)


def with_tasks(demos: Demonstrations, tasks: Sequence[str] = ()) -> Demonstrations:
    """Demonstrations with the observation ``task``.

    :param tasks: of its numbers; if empty, those of the demonstrations in alphabetical order.
    :raises DemonstrationsError: a demonstration names no task, and no tasks are given.
    """
    for name, task in zip(demos.names, demos.tasks, strict=True):
        if not (task or tasks):
            wanted = f"give it the attribute {' or '.join(NAMES)}"
            raise DemonstrationsError(f"observations: task: {name} names none; {wanted}")
    tasks = tasks or sorted({*demos.tasks}, key=natural)
    each = tuple(with_task(demo, tasks) for demo in demos)
    return replace(demos, demonstrations=each, attributes={**demos.attributes, TASKS: json.dumps(tasks)})


def with_labels_of_tasks(demos: Demonstrations) -> Demonstrations:
    """Demonstrations of several tasks with labels that differ between tasks, unless the file names them."""
    known = label_names(demos.attributes)
    each, names = of_tasks(demos.tasks, [demo.labels for demo in demos], known)
    if names == known:
        return demos
    pairs = zip(demos, each, strict=True)
    parts = tuple(Demonstration.stored(**{**vars(demo), "labels": own}) for demo, own in pairs)
    attributes = {**demos.attributes, LABEL_NAMES: json.dumps(names)}
    return replace(demos, demonstrations=parts, attributes=attributes)


def not_demonstrations(given: object) -> DemonstrationsError:
    """The error about something else in place of demonstrations, or of one of them."""
    return DemonstrationsError(
        "demonstrations have to be a list of ddco_pyro.Demonstration(name, observations, actions), or "
        f"ddco_pyro.Demonstrations.read(FILE); got {type(given).__name__}"
    )


# --- division -----------------------------------------------------------------------------------------------


def split_by_masks(names: Sequence[str], masks: Masks) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Training and validation demonstrations by the masks ``train`` and ``valid``.

    If one of the masks is missing, it has all other demonstrations.

    :raises DemonstrationsError: the masks overlap, or one of the two parts is empty.
    """
    given = {mask: tuple(dict.fromkeys(masks[mask])) for mask in ("train", "valid") if mask in masks}
    train = given.get("train", tuple(name for name in names if name not in given.get("valid", ())))
    valid = given.get("valid", tuple(name for name in names if name not in train))
    for purpose, members in (("train", train), ("validate", valid)):
        if not members:
            none = f"no demonstration is left to {purpose} with"
            raise DemonstrationsError(f"{none}; add some or change the masks")
    if both := {*train} & {*valid}:
        first = min(both, key=natural)
        raise DemonstrationsError(f"{first} is in mask/train and in mask/valid; remove it from one")
    return train, valid


def with_values(attribute: str, known: Known, fraction: float, seed: int) -> dict[str, tuple[str, ...]]:
    """Demonstrations to hold out by some values of an attribute, about a fraction of all: names by value.

    :param known: the attributes of each demonstration by its name.
    :param seed: draws the order in which values are tried.
    :raises DemonstrationsError: a demonstration lacks the attribute, or all have one value.
    """
    members = {value: tuple(names) for value, names in by_value(attribute, known).items()}
    if len(members) == 1:
        (value,) = members
        alike = f"attribute {attribute!r} is {value} in all demonstrations"
        raise DemonstrationsError(f"{alike}; hold out by another one")
    values, wanted = sorted(members, key=natural), fraction * len(known)
    chosen, number = dict[str, tuple[str, ...]](), 0
    for place in np.random.default_rng(seed).permutation(len(values)):
        more = number + len(members[values[place]])
        if abs(more - wanted) < abs(number - wanted) and more < len(known):
            chosen[values[place]], number = members[values[place]], more
    chosen = chosen or dict([min(members.items(), key=lambda one: len(one[1]))])
    return {value: chosen[value] for value in values if value in chosen}


def drawn(known: Known, fraction: float, seed: int) -> tuple[str, ...]:
    """Demonstrations to hold out, about a fraction of those of each task: at least one of each that has two.

    Those that are alone with their task are one more group.

    :param known: the attributes of each demonstration by its name.
    """
    random, held_out, tasks = np.random.default_rng(seed), set[str](), by_task(known).values()
    alone = [name for names in tasks if len(names) == 1 for name in names]
    for names in (*(names for names in tasks if len(names) > 1), alone):
        number = min(max(round(fraction * len(names)), 1), len(names) - 1)
        held_out |= {names[place] for place in random.permutation(len(names))[:number]}
    return tuple(name for name in known if name in held_out)


def check_division(names: Sequence[str], masks: Masks) -> None:
    """Refuse demonstrations that are too few for a fit, by the masks or for a random split.

    :raises DemonstrationsError: they are too few, a mask names an unknown demonstration, or masks overlap.
    """
    for problem in problems_of_masks(masks, names):
        raise DemonstrationsError(problem)
    if masks.keys() & {"train", "valid"}:
        check_trained(split_by_masks(names, masks)[0])
    elif len(names) < LEAST:
        holds = f"holds {len(names)} demonstration{'s' * (len(names) != 1)} that can be read"
        purposes = "to train, to stop early, and to validate"
        raise DemonstrationsError(f"{holds}, and a fit needs {LEAST}: {purposes}; add some")


def check_trained(train: Sequence[str]) -> None:
    """Refuse training demonstrations that leave none to stop early.

    :raises DemonstrationsError: there is only one.
    """
    if len(train) < LEAST - 1:
        left = f"{len(train)} demonstration is left to train with, and a fit needs {LEAST - 1}"
        raise DemonstrationsError(f"{left}: to train and to stop early; add some, or hold fewer out")


def problems_of_masks(masks: Masks, names: Sequence[str]) -> Iterator[str]:
    """A line for each mask that names an unknown demonstration."""
    for mask, members in masks.items():
        if missing := sorted(set(members) - set(names)):
            yield f"mask/{mask}: {unknown(missing[0], names)}"


def unknown(name: str, names: Iterable[str]) -> str:
    """The problem with an unknown demonstration, in words."""
    return f"there is no demonstration {name!r}{nearest(name, names)}"
