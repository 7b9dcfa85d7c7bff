"""Whether demonstrations can be used and go together: by shapes and types, which headers tell, and by values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources.recording import Column, Recording
from ddco_pyro.data.values import LARGEST, NUMBERS, usable
from ddco_pyro.errors import nearest


def check(recording: Recording) -> None:
    """See that a demonstration has steps, and that its arrays hold numbers for each of them; no value is read.

    :raises DemonstrationsError: it has not, or they do not.
    """
    name, shape = recording.name, recording.actions.shape
    for place, column in recording.columns():
        if column.dtype.kind not in NUMBERS:
            raise DemonstrationsError(f"{name}: {place} holds {column.dtype}, it has to hold real numbers")
    if len(shape) != 2 or not shape[1]:
        raise DemonstrationsError(f"{name}: actions has shape {shape}, it has to be [steps, dimensions]")
    if not shape[0]:
        raise DemonstrationsError(f"{name}: actions has no steps; remove this demonstration")
    for place, column in recording.columns():
        check_steps(name, place, column, shape[0])


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
                    f"{recording.name}: {place} is {value:g} at step {before + step}, index {index}{limit}; {remedy}"
                )
            before += len(block)


def problems_of_masks(masks: Mapping[str, Sequence[str]], names: Sequence[str]) -> Iterator[str]:
    """A line for each mask that names a demonstration that is not there."""
    for mask, members in masks.items():
        missing = sorted(set(members) - set(names))
        if missing:
            yield f"mask/{mask}: {unknown(missing[0], names)}"


def unknown(name: str, names: Sequence[str]) -> str:
    """What is wrong where no demonstration has this name."""
    return f"there is no demonstration {name!r}{nearest(name, names)}"
