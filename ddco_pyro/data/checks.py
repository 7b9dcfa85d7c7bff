"""Whether demonstrations can be used and go together: by shapes and types, which headers tell, and by values."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ddco_pyro.data.control_dimensions import number
from ddco_pyro.data.hdf5 import DemonstrationsError, natural
from ddco_pyro.data.pictures import PICTURE_DIMENSIONS
from ddco_pyro.data.sources.recording import Column, Recording
from ddco_pyro.data.values import LARGEST, NUMBERS, usable
from ddco_pyro.errors import nearest

LEAST = 3
"""Demonstrations that a fit needs: to train, to stop early, and to validate."""


def check(recording: Recording) -> None:
    """See that a demonstration has steps, and that its arrays hold numbers for each of them; no value is read.

    :raises DemonstrationsError: it has not, or they do not.
    """
    name, shape = recording.name, recording.actions.shape
    for place, column in recording.columns():
        if column.dtype.kind not in NUMBERS:
            raise DemonstrationsError(f"{name}: {place} holds {column.dtype}, it has to hold real numbers")
    if problem := problem_of_controls(shape[1:], recording.actions.dtype):
        raise DemonstrationsError(f"{name}: actions {problem}")
    if not shape[0]:
        raise DemonstrationsError(f"{name}: actions has no steps; remove this demonstration")
    for place, column in recording.columns():
        check_steps(name, place, column, shape[0])


def problem_of_controls(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """What is wrong with controls whose steps have this shape; nothing where nothing is."""
    if len(shape) == 1 and shape[0]:
        return ""
    if shape:
        return f"has shape {list(shape)} at each step, it has to be [dimensions]"
    return (
        f"is {dtype} of shape [steps]; store discrete actions as integers (astype(int)), and anything else as "
        "[steps, 1] (actions[:, None])"
    )


def problem_of_pictures(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """What is wrong with pictures whose steps have this shape; nothing where nothing is, or they are none."""
    if len(shape) != PICTURE_DIMENSIONS or dtype == np.uint8:
        return ""
    return (
        f"is {dtype} of shape {list(shape)} at each step: pictures have to be uint8; scale the range that "
        "matters to it, such as (255 * (depth / far).clip(0, 1)).astype('uint8')"
    )


def problem_of_labels(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """What is wrong with labels whose steps have this shape; nothing where nothing is."""
    if dtype.kind in "iub" and not shape:
        return ""
    had = "text" if dtype.kind in "OSU" else str(dtype)
    return f"is {had} of shape [{', '.join(map(str, ('steps', *shape)))}], it has to be integers of shape [steps]"


def check_steps(name: str, place: str, column: Column, steps: int) -> None:
    """See that an array of a demonstration has as many steps as its controls.

    :raises DemonstrationsError: it has not.
    """
    if column.shape[:1] != (steps,):
        had = column.shape[0] if column.shape else "no"
        raise DemonstrationsError(f"{name}: {place} has {had} steps, but actions has {steps}")


def check_alike(recording: Recording, first: Recording) -> None:
    """See that a demonstration has the same arrays as the first one, with steps of the same shapes.

    :raises DemonstrationsError: it has not.
    """
    ours, theirs = dict(recording.columns()), dict(first.columns())
    missing, more = sorted(theirs.keys() - ours.keys()), sorted(ours.keys() - theirs.keys())
    if missing:
        raise DemonstrationsError(f"{recording.name}: {', '.join(missing)} is missing, which {first.name} has")
    if more:
        raise DemonstrationsError(
            f"{recording.name}: {', '.join(more)} is not in {first.name}; all demonstrations need the same"
        )
    for place, column in ours.items():
        check_shape(f"{recording.name}: {place}", column, theirs[place].shape[1:], first.name)


def check_shape(where: str, column: Column, expected: tuple[int, ...], first: str) -> None:
    """See that a step of an array has the shape that it has in the first demonstration.

    :raises DemonstrationsError: it has another one.
    """
    if column.shape[1:] != expected:
        raise DemonstrationsError(
            f"{where} has shape {column.shape[1:]} at each step, but {expected} in {first}; "
            "all demonstrations need the same"
        )


def check_values(recording: Recording, remedy: str = "repair it") -> None:
    """See that every number of a demonstration can be used, block by block.

    :param remedy: what to do where one cannot.
    :raises DemonstrationsError: one is NaN, infinite or beyond :data:`ddco_pyro.data.values.LARGEST`.
    """
    for place, column in recording.columns():
        if column.dtype.kind != "f":
            continue  # whole numbers can all be used
        before = 0
        for block in column.blocks():
            good = usable(block)
            if not good.all():
                step, *index = np.argwhere(~good)[0].tolist()
                value = block[step, *index]
                limit = f", and at most {LARGEST:g} can be used" if np.isfinite(value) else ""
                raise DemonstrationsError(
                    f"{recording.name}: {place} is {number(value)} at step {before + step}, index {index}{limit}; "
                    f"{remedy}"
                )
            before += len(block)


def divided(names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The demonstrations to train with and those to validate with, as the masks ``train`` and ``valid`` say.

    One of the masks alone leaves the rest to the other.

    :raises DemonstrationsError: the masks overlap, or leave nothing to one of the two.
    """
    given = {mask: dict.fromkeys(masks[mask]) for mask in ("train", "valid") if mask in masks}
    train = given["train"] if "train" in given else _without(names, given.get("valid", ()))
    valid = given["valid"] if "valid" in given else _without(names, train)
    for purpose, members in (("train", train), ("validate", valid)):
        if not members:
            raise DemonstrationsError(f"no demonstration is left to {purpose} with; add some or change the masks")
    both = train.keys() & valid.keys()
    if both:
        raise DemonstrationsError(f"{min(both, key=natural)} is in mask/train and in mask/valid; remove it from one")
    return tuple(train), tuple(valid)


def _without(names: Sequence[str], others: Collection[str]) -> dict[str, None]:
    left_out = set(others)
    return {name: None for name in names if name not in left_out}


def check_division(names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> None:
    """See that demonstrations are enough to train, to stop early, and to validate, by masks or drawn at random.

    :raises DemonstrationsError: they are not, a mask names a stranger, or the masks overlap.
    """
    for problem in problems_of_masks(masks, names):
        raise DemonstrationsError(problem)
    if masks.keys() & {"train", "valid"}:
        check_trained(divided(names, masks)[0])
    elif len(names) < LEAST:
        raise DemonstrationsError(
            f"holds {len(names)} demonstration{'s' * (len(names) != 1)} that can be read, and a fit needs {LEAST}: to "
            "train, to stop early, and to validate; add some"
        )


def check_trained(train: Sequence[str]) -> None:
    """See that the demonstrations to train with can be divided once more.

    :raises DemonstrationsError: there is one only.
    """
    if len(train) < LEAST - 1:
        raise DemonstrationsError(
            f"{len(train)} demonstration is left to train with, and a fit needs {LEAST - 1}: to train and to stop "
            "early; add some, or hold fewer out"
        )


def problems_of_masks(masks: Mapping[str, Sequence[str]], names: Sequence[str]) -> Iterator[str]:
    """A line for each mask that names a demonstration that is not there."""
    for mask, members in masks.items():
        missing = sorted(set(members) - set(names))
        if missing:
            yield f"mask/{mask}: {unknown(missing[0], names)}"


def unknown(name: str, names: Sequence[str]) -> str:
    """What is wrong where no demonstration has this name."""
    return f"there is no demonstration {name!r}{nearest(name, names)}"
