"""A demonstration: arrays by name, as they are stored or ready for a fit, and whether it can be used."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from ddco_pyro.data.arrays import (
    LARGEST,
    NUMBERS,
    PROGRAM,
    LazyArray,
    Observed,
    blocks,
    in_file,
    is_picture,
    network_input,
    no_numbers,
    turned,
    usable,
)
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.errors import nearest

Attribute = float | int | str | bool

NOTHING: Mapping[str, Any] = MappingProxyType({})

DIMENSION_NAMES = "dimension_names"
"""Attribute of a source: JSON, the names of the dimensions of observations, and of ``control``, by key."""


@dataclass(frozen=True, eq=False, repr=False)
class Demonstration:
    """One demonstration of T steps, s_0 a_0 ... s_{T-1} a_{T-1}.

    >>> observations, labels = {"place": np.zeros((10, 2))}, {"phase": [0] * 10}
    >>> demo = ddco_pyro.Demonstration("demo_0", observations, np.ones((10, 2)), labels)
    >>> len(demo), demo.actions.dtype, demo.labels["phase"].shape
    (10, dtype('float64'), (10,))

    :param observations: key to [T, ...]; uint8 stays, other numbers become float64. Pictures uint8 [T, C, H,
        W] or [T, H, W] become [T, H, W, C]. Pictures in files are a lazy
        :class:`~ddco_pyro.data.arrays.LazyArray`.
    :param actions: the controls [T, A], float64; whole numbers [T] or [T, A] become int64.
    :param labels: ground-truth segments by name, [T] or [T, 1], int64.
    :param attributes: facts about the demonstration, such as its seed.
    :raises DemonstrationsError: no steps, unequal lengths, other values than numbers, or numbers that are
        NaN, infinite or beyond :data:`ddco_pyro.data.arrays.LARGEST`.
    """

    name: str
    observations: Mapping[str, Observed]
    actions: np.ndarray
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    attributes: Mapping[str, Attribute] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or "/" in self.name:
            wanted = "it must be a text, not empty, without a /"
            raise DemonstrationsError(f"{self.name!r} cannot be the name of a demonstration; {wanted}")
        for what, arrays in (("observations", self.observations), ("labels", self.labels)):
            if not isinstance(arrays, Mapping) or not all(isinstance(key, str) for key in arrays):
                wanted = "a mapping of names to arrays [T, ...]"
                raise DemonstrationsError(f"{self.name}: {what} have to be {wanted}")
        given = Demonstration.stored(**vars(self))
        check(given)
        vars(self).update(
            observations={key: _ready(array) for key, array in given.observations.items()},
            actions=given.actions.astype(np.int64 if given.actions.dtype.kind in "iu" else np.float64),
            labels={key: values.astype(np.int64) for key, values in given.labels.items()},
        )
        check_values(self, f"repair it, or leave {self.name} out (demonstrations.exclude)")

    @classmethod
    def stored(
        cls,
        name: str,
        observations: Mapping[str, Any],
        actions: Any,
        labels: Mapping[str, Any] = NOTHING,
        attributes: Mapping[str, Attribute] = NOTHING,
    ) -> Demonstration:
        """A demonstration as its source stores it: of any types, observations lazy or not, not yet checked.

        Pictures get their channels last, whole numbers as controls [T] become [T, 1], and labels [T, 1]
        become [T]. ``Demonstration(**vars(stored))`` is the same, checked and ready for a fit.

        :raises DemonstrationsError: something is no array.
        """

        def array(place: str, values: Any) -> Any:
            try:
                return values if isinstance(values, LazyArray) else turned(np.asarray(values))
            except (ValueError, TypeError, RuntimeError) as error:
                text = " ".join(str(error).split())
                raise DemonstrationsError(f"{name}: {place} is no array: {text}") from None

        demo, control = object.__new__(cls), array("actions", actions)
        known = {key: array(f"labels/{key}", values) for key, values in labels.items()}
        flat = {key: each[:, 0] if each.shape[1:] == (1,) else each for key, each in known.items()}
        seen = {key: array(f"obs/{key}", values) for key, values in observations.items()}
        control = control[:, None] if control.dtype.kind in "iu" and control.ndim == 1 else control
        vars(demo).update(name=name, observations=seen, actions=control, labels=flat, attributes=attributes)
        return demo

    def arrays(self) -> dict[str, Observed]:
        """Every array by its place: ``actions``, ``obs/<key>``, ``labels/<name>``."""
        seen = {f"obs/{key}": array for key, array in self.observations.items()}
        known = {f"labels/{key}": array for key, array in self.labels.items()}
        return {"actions": self.actions, **seen, **known}

    def controls(self, relative_to: str | None = None) -> np.ndarray:
        """The controls [T, A]; minus the observation of this key, where there is one.

        :raises DemonstrationsError: the observation has not the shape of the controls.
        """
        if relative_to is None:
            return self.actions
        seen = self.observations[relative_to]
        if is_picture(seen) or seen.shape != self.actions.shape:
            shapes = f"{[*seen.shape[1:]]} at each step, and the control {[*self.actions.shape[1:]]}"
            differs = f"obs/{relative_to} has shape {shapes}"
            raise DemonstrationsError(f"control.relative_to: {differs}; both have to be equal")
        return self.actions - np.asarray(seen, np.float64)

    def __len__(self) -> int:
        return len(self.actions) if self.actions.ndim else 0

    def __repr__(self) -> str:
        return f"{self.name}: {len(self)} steps{self.shapes}"

    @property
    def shapes(self) -> str:
        """The arrays, a line each."""
        each = self.arrays().items()
        return "".join(f"\n  {place} {[*array.shape[1:]]} {array.dtype}" for place, array in each)


def _ready(array: Observed) -> Observed:
    """An observation as fits read it; pictures in files stay lazy."""
    if in_file(array):
        return array
    values = np.asarray(array)
    return values if values.dtype == np.uint8 else values.astype(np.float64)


# --- checks -------------------------------------------------------------------------------------------------


def check(demo: Demonstration, first: Demonstration | None = None) -> None:
    """Refuse a demonstration that cannot be used, or not together with the first one; no lazy value is read.

    It has no steps, an array of something else than numbers or of other steps than the controls; or its
    arrays, or their shapes at one step, are not those of the first demonstration.

    :raises DemonstrationsError: it is such a demonstration.
    """
    for problem in _problems(demo, demo if first is None else first):
        raise DemonstrationsError(f"{demo.name}: {problem}")


def _problems(demo: Demonstration, other: Demonstration) -> Iterator[str]:
    """The problems with a demonstration beside another one; each makes sense only if none comes before it."""
    ours, theirs = demo.arrays(), other.arrays()
    for place, array in ours.items():
        if array.dtype.kind not in NUMBERS:
            yield f"{place} {no_numbers(array.dtype)}"
    if problem := problem_of("actions", demo.actions.shape[1:], demo.actions.dtype):
        yield f"actions {problem}"
    if not len(demo):
        yield "actions has no steps; remove this demonstration"
    if missing := sorted(theirs.keys() - ours.keys()):
        yield f"{', '.join(missing)} is missing, which {other.name} has"
    if more := sorted(ours.keys() - theirs.keys()):
        yield f"{', '.join(more)} is not in {other.name}; all demonstrations need the same"
    for place, array in ours.items():
        problem = problem_of(place, array.shape[1:], array.dtype) if place.startswith("labels/") else ""
        if problem := problem or different(array, len(demo), theirs[place].shape[1:], other.name):
            yield f"{place} {problem}"


def problem_of(place: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    """The problem with an array whose steps have this shape and type, in words; empty without a problem."""
    if place.startswith("obs/"):
        return network_input(shape, dtype)[1]
    if place.startswith("labels/"):
        if dtype.kind in "iub" and not shape:
            return ""
        had = "text" if dtype.kind in "OSU" else str(dtype)
        size = ", ".join(map(str, ("steps", *shape)))
        return f"is {had} of shape [{size}], it has to be integers of shape [steps]"
    if dtype.kind not in NUMBERS:
        return no_numbers(dtype)
    if shape:
        wrong = f"has shape {list(shape)} at each step, it has to be [dimensions]"
        return "" if len(shape) == 1 and shape[0] else wrong
    return (
        f"is {dtype} of shape [steps]; store discrete actions as integers (astype(int)), and anything else "
        "as [steps, 1] (actions[:, None])"
    )


def different(array: Observed, steps: int, shape: tuple[int, ...], first: str) -> str:
    """How an array differs from the controls in steps, or the first demonstration in shape; else empty."""
    if array.shape[:1] != (steps,):
        return f"has {array.shape[0] if array.shape else 'no'} steps, but actions has {steps}"
    if array.shape[1:] != shape:
        has = f"has shape {array.shape[1:]} at each step, but {shape} in {first}"
        return f"{has}; all demonstrations need the same"
    return ""


def check_values(demo: Demonstration, remedy: str = "repair it", pictures: bool = False) -> None:
    """Refuse a demonstration with a number that is not :func:`~ddco_pyro.data.arrays.usable`.

    :param remedy: what the user can do.
    :param pictures: whether pictures are read too, which takes long; their values are usable.
    :raises DemonstrationsError: a number is NaN, infinite or too large, or an array cannot be read.
    """
    for place, array in demo.arrays().items():
        before = 0
        for block in () if is_picture(array) and not pictures else blocks(array):
            good = usable(block)
            if not good.all():
                step, *index = np.argwhere(~good)[0].tolist()
                value = block[step, *index]
                limit = f", and at most {LARGEST:g} can be used" if np.isfinite(value) else ""
                at = f"at step {before + step}, index {index}"
                raise DemonstrationsError(f"{demo.name}: {place} is {number(value)} {at}{limit}; {remedy}")
            before += len(block)


def check_fitted(demo: Demonstration, shapes: Mapping[str, tuple[int, ...]], control_size: int) -> None:
    """Refuse a demonstration that a model cannot read which was fitted to other shapes.

    :param shapes: of the model's observations at one step.
    :param control_size: A of the fit.
    :raises DemonstrationsError: an observation is missing, or it or the control has another shape or type.
    """
    known = demo.observations
    for key in shapes:
        if key not in known:
            lacks = f"there is no observation {key!r}{nearest(key, known)}, which the run was fitted to"
            raise DemonstrationsError(f"{demo.name}: {lacks}; there is: {', '.join(known)}")
    fitted: dict[str, tuple[Observed, tuple[int, ...]]] = {"actions": (demo.actions, (control_size,))}
    fitted |= {f"obs/{key}": (known[key], tuple(shape)) for key, shape in shapes.items()}
    for place, (array, expected) in fitted.items():
        if array.shape[1:] != expected:
            has = f"{place} has shape {array.shape[1:]} at each step"
            raise DemonstrationsError(f"{demo.name}: {has}, the run was fitted to {expected}")
        if why := network_input(array.shape[1:], array.dtype)[1]:
            raise DemonstrationsError(f"{demo.name}: {place} {why}")


# --- numbers ------------------------------------------------------------------------------------------------


def number(value: float) -> str:
    """A value with as few digits as identify it in its type, single or double; never as minus zero."""
    value = float(value) + 0.0
    if value.is_integer() and abs(value) < 1e16:
        return str(int(value))
    with np.errstate(over="ignore"):
        single = np.float32(value)
    return str(single) if float(single) == value else str(value)


COPIES = 4.0 + 16.0
"""Bytes per number beyond the array as read: float32 in a padded batch, and two temporary float64 copies."""


def needed(demos: Iterable[Demonstration], copies: float = COPIES) -> float:
    """Bytes for demonstrations, by their arrays' shapes: arrays as read, and copies padded to the longest.

    Pictures that stay in their file count for nothing.

    :param copies: bytes of a number beyond the array as read.
    """
    count, longest, size, features = 0, 0, 0, 0
    for demo in demos:
        count, longest, numbers = count + 1, max(longest, len(demo)), 0
        for place, array in demo.arrays().items():
            if not in_file(array):
                size += math.prod(array.shape) * (1 if array.dtype == np.uint8 else 8)
            if not (place.startswith("labels/") or is_picture(array)):
                numbers += math.prod(array.shape[1:])
        features = max(features, numbers)
    return PROGRAM + size + copies * features * count * longest
