"""Demonstrations to train and to validate with, by masks or values of an attribute, and whether they are enough."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.hdf5 import natural
from ddco_pyro.data.tasks import Known, by_task, by_value
from ddco_pyro.errors import nearest

LEAST = 3
"""Fewest demonstrations for a fit: to train, to stop early, and to validate."""

FEW = 8
"""Of fewer demonstrations none is held out from the fit: a part to tune by and a part to validate leave too few."""


def split_by_masks(names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Training and validation demonstrations by the masks ``train`` and ``valid``.

    If one of the masks is missing, it has all other demonstrations.

    :raises DemonstrationsError: the masks overlap, or one of the two parts is empty.
    """
    given = {mask: tuple(dict.fromkeys(masks[mask])) for mask in ("train", "valid") if mask in masks}
    train = given.get("train", tuple(name for name in names if name not in given.get("valid", ())))
    valid = given.get("valid", tuple(name for name in names if name not in train))
    for purpose, members in (("train", train), ("validate", valid)):
        if not members:
            raise DemonstrationsError(f"no demonstration is left to {purpose} with; add some or change the masks")
    if both := {*train} & {*valid}:
        raise DemonstrationsError(f"{min(both, key=natural)} is in mask/train and in mask/valid; remove it from one")
    return train, valid


def with_values(attribute: str, known: Known, fraction: float, seed: int) -> dict[str, tuple[str, ...]]:
    """Demonstrations to hold out by some values of an attribute, about a fraction of all: their names by value.

    :param known: the attributes of each demonstration by its name.
    :param seed: draws the order in which values are tried.
    :raises DemonstrationsError: a demonstration lacks the attribute, or all have one value.
    """
    members = {value: tuple(names) for value, names in by_value(attribute, known).items()}
    if len(members) == 1:
        (value,) = members
        raise DemonstrationsError(f"attribute {attribute!r} is {value} in all demonstrations; hold out by another one")
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


def check_division(names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> None:
    """Refuse demonstrations that are too few for a fit, by the masks or for a random split.

    :raises DemonstrationsError: they are too few, a mask names an unknown demonstration, or the masks overlap.
    """
    for problem in problems_of_masks(masks, names):
        raise DemonstrationsError(problem)
    if masks.keys() & {"train", "valid"}:
        check_trained(split_by_masks(names, masks)[0])
    elif len(names) < LEAST:
        raise DemonstrationsError(
            f"holds {len(names)} demonstration{'s' * (len(names) != 1)} that can be read, and a fit needs {LEAST}: to "
            "train, to stop early, and to validate; add some"
        )


def check_trained(train: Sequence[str]) -> None:
    """Refuse training demonstrations that leave none to stop early.

    :raises DemonstrationsError: there is only one.
    """
    if len(train) < LEAST - 1:
        raise DemonstrationsError(
            f"{len(train)} demonstration is left to train with, and a fit needs {LEAST - 1}: to train and to stop "
            "early; add some, or hold fewer out"
        )


def problems_of_masks(masks: Mapping[str, Sequence[str]], names: Sequence[str]) -> Iterator[str]:
    """A line for each mask that names an unknown demonstration."""
    for mask, members in masks.items():
        if missing := sorted(set(members) - set(names)):
            yield f"mask/{mask}: {unknown(missing[0], names)}"


def unknown(name: str, names: Iterable[str]) -> str:
    """The problem with an unknown demonstration, in words."""
    return f"there is no demonstration {name!r}{nearest(name, names)}"
