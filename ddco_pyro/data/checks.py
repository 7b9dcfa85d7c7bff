"""Checks of demonstrations: shapes and types, values, masks, and whether there are enough to fit to."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import h5py
import numpy as np

from ddco_pyro.data.controls import number
from ddco_pyro.data.hdf5 import Attribute, DemonstrationsError, natural
from ddco_pyro.data.pictures import PICTURE_DIMENSIONS
from ddco_pyro.data.sources.recording import NUMBERS, Column, Recording
from ddco_pyro.errors import nearest

# --- values -----------------------------------------------------------------------------------------------------------

LARGEST = 1e30
"""Largest usable number: networks are float32, which ends at 3e38, and variances are float64, which ends at 1e308."""


def usable(values: np.ndarray) -> np.ndarray:
    """Whether each real number is finite and at most :data:`LARGEST` in size."""
    if values.dtype.kind != "f":
        return np.ones(values.shape, dtype=bool)
    return np.abs(values) <= min(LARGEST, float(np.finfo(values.dtype).max))  # false for NaN


RESOLUTION = 1e-9
"""A dimension is treated as constant if its range is below RESOLUTION × its largest magnitude, or for coarser types
:data:`LAST_PLACES` units in the last place."""

LAST_PLACES = 4

SETTLED = 256 * float(np.finfo(np.float32).eps)
"""A dimension is treated as constant if its range is below SETTLED (3e-5) × the observation's largest magnitude, at
most 1. Simulators round all components of a vector alike in every step: components of a quaternion at rest vary by 6e-7
to 1.6e-5 in Meta-World's files. The bound of 1 is for mixed units, where one dimension may be in the thousands."""


def rounding(low: np.ndarray, high: np.ndarray, dtype: np.dtype[Any]) -> np.ndarray:
    """The largest range of each dimension that counts as rounding, [D]; wider dimensions vary.

    :param low: the smallest value of each dimension of an observation [D]; ``high`` the largest. Values that are not
        finite give NaN.
    :param dtype: the type of the values in the file; whole numbers are not rounded.
    """
    sizes = np.maximum(np.abs(np.asarray(low, np.float64)), np.abs(np.asarray(high, np.float64)))
    finite = np.isfinite(sizes)
    if dtype.kind != "f":
        return np.where(finite, 0.0, np.nan)
    own = max(RESOLUTION, LAST_PLACES * float(np.finfo(dtype).eps)) * np.maximum(sizes, RESOLUTION)
    largest = min(1.0, float(sizes.max(initial=0.0, where=finite)))
    return np.where(finite, np.maximum(own, SETTLED * largest), np.nan)


def check_values(recording: Recording, remedy: str = "repair it", pictures: bool = False) -> None:
    """Refuse a demonstration with a number that is not :func:`usable`; arrays are read block by block.

    :param remedy: what the user can do.
    :param pictures: whether pictures are read too, which takes long; their values are usable.
    :raises DemonstrationsError: a number is NaN, infinite or too large, or an array cannot be read.
    """
    for place, column in recording.columns():
        if column.image and not pictures:
            continue
        before = 0
        for block in column.blocks():
            good = usable(block)
            if not good.all():
                step, *index = np.argwhere(~good)[0].tolist()
                value = block[step, *index]
                limit = f", and at most {LARGEST:g} can be used" if np.isfinite(value) else ""
                raise DemonstrationsError(
                    f"{recording.name}: {column.named or place} is {number(value)} at step {before + step}, "
                    f"index {index}{limit}; {remedy}"
                )
            before += len(block)


# --- shapes and types -------------------------------------------------------------------------------------------------


def check(recording: Recording) -> None:
    """Refuse a demonstration without steps, or with arrays that are not numbers for each step; no value is read.

    :raises DemonstrationsError: it is such a demonstration.
    """
    name, shape = recording.name, recording.actions.shape
    for place, column in recording.columns():
        if column.dtype.kind not in NUMBERS:
            raise DemonstrationsError(
                f"{name}: {column.named or place} holds {column.dtype}, it has to hold real numbers"
            )
    actions = recording.actions.named or "actions"
    if problem := problem_of_controls(shape[1:], recording.actions.dtype):
        raise DemonstrationsError(f"{name}: {actions} {problem}")
    if not shape[0]:
        raise DemonstrationsError(f"{name}: {actions} has no steps; remove this demonstration")
    for place, column in recording.columns():
        check_steps(name, place, column, shape[0])


PICTURES = np.dtype(np.uint8)
"""The type of pictures that networks read."""


def reading(shape: tuple[int, ...], dtype: np.dtype[Any] = PICTURES) -> tuple[Literal["vector", "picture", ""], str]:
    """What networks read of an observation whose steps have this shape and type, else why they read nothing of it.

    Real numbers of at most two dimensions are a vector, flattened. A picture is uint8 [H, W, C].

    >>> reading((4, 4), np.dtype(np.float32)), reading((48, 64, 3))
    (('vector', ''), ('picture', ''))
    """
    if dtype.kind not in NUMBERS:
        return "", _no_numbers(dtype)
    if 0 in shape:
        return "", f"has shape {list(shape)} at each step, and so no numbers"
    if len(shape) < PICTURE_DIMENSIONS:
        return "vector", ""
    if len(shape) > PICTURE_DIMENSIONS:
        return "", (
            f"has shape {list(shape)} at each step, and networks read vectors and pictures [H, W, C]; store one "
            "picture a step (frames stacks them), or reshape it to [steps, dimensions]"
        )
    if dtype == PICTURES:
        return "picture", ""
    return "", (
        f"has shape {list(shape)} at each step and is not uint8, as pictures have to be; scale the range that "
        "matters to it, such as (255 * (depth / far).clip(0, 1)).astype('uint8')"
    )


def _no_numbers(dtype: np.dtype[Any]) -> str:
    text = dtype.kind in "STU" or h5py.check_string_dtype(dtype)
    return f"holds {'text' if text else 'text or other objects' if dtype.kind == 'O' else dtype}, not numbers"


def problem_of_controls(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """The problem with controls whose steps have this shape, in words; empty without a problem."""
    if dtype.kind not in NUMBERS:
        return _no_numbers(dtype)
    if len(shape) == 1 and shape[0]:
        return ""
    if shape:
        return f"has shape {list(shape)} at each step, it has to be [dimensions]"
    return (
        f"is {dtype} of shape [steps]; store discrete actions as integers (astype(int)), and anything else as "
        "[steps, 1] (actions[:, None])"
    )


def problem_of_labels(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """The problem with labels whose steps have this shape; empty without a problem."""
    if dtype.kind in "iub" and not shape:
        return ""
    had = "text" if dtype.kind in "OSU" else str(dtype)
    return f"is {had} of shape [{', '.join(map(str, ('steps', *shape)))}], it has to be integers of shape [steps]"


def check_steps(name: str, place: str, column: Column, steps: int) -> None:
    """Refuse an array that has another number of steps than the controls.

    :raises DemonstrationsError: it has.
    """
    if column.shape[:1] != (steps,):
        had = column.shape[0] if column.shape else "no"
        raise DemonstrationsError(f"{name}: {place} has {had} steps, but actions has {steps}")


def check_alike(recording: Recording, first: Recording) -> None:
    """Refuse a demonstration whose arrays, or their shapes at one step, differ from those of the first demonstration.

    :raises DemonstrationsError: they differ.
    """
    ours, theirs = dict(recording.columns()), dict(first.columns())
    missing = sorted(theirs[place].named or place for place in theirs.keys() - ours.keys())
    more = sorted(ours[place].named or place for place in ours.keys() - theirs.keys())
    if missing:
        raise DemonstrationsError(f"{recording.name}: {', '.join(missing)} is missing, which {first.name} has")
    if more:
        raise DemonstrationsError(
            f"{recording.name}: {', '.join(more)} is not in {first.name}; all demonstrations need the same"
        )
    for place, column in ours.items():
        check_shape(f"{recording.name}: {column.named or place}", column, theirs[place].shape[1:], first.name)


def check_shape(where: str, column: Column, expected: tuple[int, ...], first: str) -> None:
    """Refuse an array whose shape at one step differs from the first demonstration.

    :raises DemonstrationsError: it differs.
    """
    if column.shape[1:] != expected:
        raise DemonstrationsError(
            f"{where} has shape {column.shape[1:]} at each step, but {expected} in {first}; "
            "all demonstrations need the same"
        )


def check_fitted(recording: Recording, shapes: Mapping[str, tuple[int, ...]], control_size: int) -> None:
    """Refuse a demonstration that a model cannot read which was fitted to other shapes.

    :param shapes: of the model's observations at one step.
    :param control_size: A of the fit.
    :raises DemonstrationsError: an observation is missing, or it or the control has another shape or type.
    """
    known = recording.observations
    for key in shapes:
        if key not in known:
            raise DemonstrationsError(
                f"{recording.name}: there is no observation {key!r}{nearest(key, known)}, which the run was fitted to; "
                f"there is: {', '.join(known)}"
            )
    fitted: dict[str, tuple[Column, tuple[int, ...]]] = {"actions": (recording.actions, (control_size,))}
    fitted |= {f"obs/{key}": (known[key], tuple(shape)) for key, shape in shapes.items()}
    for place, (column, expected) in fitted.items():
        if column.shape[1:] != expected:
            raise DemonstrationsError(
                f"{recording.name}: {place} has shape {column.shape[1:]} at each step, the run was fitted to {expected}"
            )
        _, why = reading(column.shape[1:], column.dtype)
        if why:
            raise DemonstrationsError(f"{recording.name}: {place} {why}")


# --- training and validation ------------------------------------------------------------------------------------------

LEAST = 3
"""Fewest demonstrations for a fit: to train, to stop early, and to validate."""

FEW = 8
"""Of fewer demonstrations none is held out from the fit: a part to tune by and a part to validate leave too few."""


def divided(names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Training and validation demonstrations by the masks ``train`` and ``valid``.

    If one of the masks is missing, it has all other demonstrations.

    :raises DemonstrationsError: the masks overlap, or one of the two parts is empty.
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


def with_values(
    attribute: str, known: Mapping[str, Mapping[str, Attribute]], fraction: float, seed: int
) -> dict[str, tuple[str, ...]]:
    """Demonstrations to hold out by some values of an attribute, about a fraction of all: their names by value.

    :param known: the attributes of each demonstration by its name.
    :param seed: draws the order in which values are tried.
    :raises DemonstrationsError: a demonstration lacks the attribute, or all have one value.
    """
    members: dict[str, tuple[str, ...]] = {}
    for name, own in known.items():
        if attribute not in own:
            there = ", ".join(dict.fromkeys(key for one in known.values() for key in one)) or "none"
            raise DemonstrationsError(
                f"{name} has no attribute {attribute!r}{nearest(attribute, own)}; there is: {there}"
            )
        value = str(own[attribute])
        members[value] = (*members.get(value, ()), name)
    if len(members) == 1:
        (value,) = members
        raise DemonstrationsError(f"attribute {attribute!r} is {value} in all demonstrations; hold out by another one")
    values, wanted, chosen, number = (
        sorted(members, key=natural),
        fraction * len(known),
        dict[str, tuple[str, ...]](),
        0,
    )
    for place in np.random.default_rng(seed).permutation(len(values)):
        more = number + len(members[values[place]])
        if abs(more - wanted) < abs(number - wanted) and more < len(known):
            chosen[values[place]], number = members[values[place]], more
    chosen = chosen or dict([min(members.items(), key=lambda one: len(one[1]))])
    return {value: chosen[value] for value in values if value in chosen}


def _without(names: Sequence[str], others: Collection[str]) -> dict[str, None]:
    left_out = set(others)
    return {name: None for name in names if name not in left_out}


def check_division(names: Sequence[str], masks: Mapping[str, Sequence[str]]) -> None:
    """Refuse demonstrations that are too few for a fit, by the masks or for a random split.

    :raises DemonstrationsError: they are too few, a mask names an unknown demonstration, or the masks overlap.
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
        missing = sorted(set(members) - set(names))
        if missing:
            yield f"mask/{mask}: {unknown(missing[0], names)}"


def unknown(name: str, names: Iterable[str]) -> str:
    """The problem with an unknown demonstration, in words."""
    return f"there is no demonstration {name!r}{nearest(name, names)}"
