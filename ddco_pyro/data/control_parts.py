"""What kind of distribution each dimension of the control has, decided from the demonstrations or declared."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ddco_pyro.data.control_dimensions import ATOM, MOST_DISTINCT, ControlDimension, number
from ddco_pyro.spec import ControlSpec, PartSpec, SpecError

KINDS = ("gaussian", "clipped", "hurdle", "binary", "categorical")


@dataclass(frozen=True)
class ControlPart:
    """Dimensions of the control whose distribution is of one kind.

    Those of a ``hurdle`` share one probability: that all of them are at their values at once.

    :param dims: which dimensions of the control, in its own numbering; constant ones are in no part.
    :param kind: one of :data:`KINDS`.
    :param low: of each dimension, in the control's own units: the lower bound (-inf for none) of a ``clipped`` or
        ``hurdle`` one, the lower of a ``binary`` one's two values; ``high`` likewise. Empty for other kinds.
    :param values: the actions that a ``categorical`` part's single dimension takes; empty where actions are rows.
    :param exact: the value of each ``hurdle`` dimension that has a probability; empty for other kinds.
    :param why: what decided on the kind.
    """

    name: str
    dims: tuple[int, ...]
    kind: str
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    values: tuple[float, ...] = ()
    why: str = ""
    exact: tuple[float, ...] = ()

    @property
    def continuous(self) -> bool:
        """Whether its distribution has a σ."""
        return self.kind in ("gaussian", "clipped", "hurdle")

    @property
    def bounded(self) -> bool:
        """Whether it is continuous up to a bound that it reaches."""
        return self.continuous and any(map(math.isfinite, (*self.low, *self.high)))

    @property
    def size(self) -> int:
        """Numbers that a network gives for it."""
        return len(self.values) or len(self.dims) + bool(self.exact)

    def as_data(self) -> dict[str, Any]:
        """The same as plain data."""
        return asdict(self)

    @classmethod
    def of(cls, data: dict[str, Any]) -> ControlPart:
        """That of plain data."""
        lists = {key: tuple(value) for key, value in data.items() if isinstance(value, list)}
        return cls(**{**data, **lists})


def described(parts: Sequence[ControlPart]) -> list[str]:
    """A line for each part: its dimensions, its kind, and why."""
    return [f"control {listed(part.dims)}: {part.kind}" + (f" ({part.why})" if part.why else "") for part in parts]


def listed(dims: Sequence[int]) -> str:
    """``dimension 3``, or ``dimensions 0-2, 5``."""
    runs: list[list[int]] = []
    for dimension in sorted(dims):
        if runs and dimension == runs[-1][-1] + 1:
            runs[-1].append(dimension)
        else:
            runs.append([dimension])
    texts = (str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
    return ("dimension " if len(dims) == 1 else "dimensions ") + ", ".join(texts)


def measure(parts: Sequence[ControlPart]) -> dict[str, list[Any]]:
    """What a log-likelihood is about, by dimension; with another measure it cannot be compared.

    A kind, then the bounds of a ``clipped`` dimension (None for none) or the values of a discrete one. Of a ``hurdle``
    its bounds, its value, and the dimensions that are at theirs at once.
    """
    dimensions: dict[str, list[Any]] = {}
    for part in parts:
        for place, dimension in enumerate(part.dims):
            ends = [part.low[place], part.high[place]] if part.low else []
            about = [end if math.isfinite(end) else None for end in ends] or list(part.values)
            exact = [part.exact[place], list(part.dims)] if part.exact else []
            dimensions[str(dimension)] = [part.kind, *about, *exact]
    return dimensions


def difference(ours: Sequence[ControlPart], theirs: Sequence[ControlPart]) -> str:
    """In which control dimension two measures differ, and how; nothing where they are the same."""
    first, second = measure(ours), measure(theirs)
    for dimension in sorted(set(first) | set(second), key=int):
        told = [_told(each.get(dimension)) for each in (first, second)]
        if first.get(dimension) != second.get(dimension):
            return f"control dimension {dimension} is {told[0]} in one and {told[1]} in the other"
    return ""


def _told(measured: Sequence[Any] | None) -> str:
    if measured is None:
        return "no part of the likelihood"
    kind, *about = measured
    ends = " and ".join("none" if end is None else number(end) for end in about[:2])
    told = f"{kind} with bounds {ends}" if kind in ("clipped", "hurdle") else str(kind)
    return f"{told} at {number(about[2])}, of {listed(about[3])}" if kind == "hurdle" else told


def all_gaussian(varying: Sequence[int]) -> tuple[ControlPart, ...]:
    """One Gaussian part of these dimensions: what is modelled where no demonstrations are known yet."""
    return (ControlPart("gaussian", tuple(varying), "gaussian"),)


def control_parts(spec: ControlSpec, dimensions: Sequence[ControlDimension]) -> tuple[ControlPart, ...]:
    """The parts of a control of which demonstrations show these dimensions: the spec's, then the others by kind.

    :raises SpecError: the spec asks for what does not fit the demonstrations.
    """
    refuse_unknown_dimensions(spec, len(dimensions))
    varying = {dim.number: dim for dim in dimensions if not dim.constant}
    named = []
    for place, part in enumerate(spec.parts):
        own = [varying.pop(dimension) for dimension in part.dims if dimension in varying]
        named += list(_parts(part.kind, own, f"control.parts.{place}", part))
    return (*named, *_parts(spec.kind, list(varying.values()), "control", None))


def refuse_unknown_dimensions(spec: ControlSpec, size: int) -> None:
    """See that a control of this size has every dimension that is named.

    :raises SpecError: it does not.
    """
    for place, part in enumerate(spec.parts):
        unknown = [dimension for dimension in part.dims if dimension >= size]
        if unknown:
            raise SpecError(
                f"control.parts.{place}.dims: there is no control dimension {unknown[0]}; the control has {size}, "
                "counted from 0"
            )


def _parts(
    kind: str, dimensions: Sequence[ControlDimension], place: str, spec: PartSpec | None
) -> Iterator[ControlPart]:
    """One part for each kind among the dimensions."""
    if kind == "categorical" and dimensions:
        name, rows = spec.name if spec else kind, all(dim.values == (0.0, 1.0) for dim in dimensions)
        if rows and len(dimensions) > 1:
            yield _rows(dimensions, name)
        else:
            yield from _actions(dimensions, place, name)
        return
    alone = len(dimensions) == 1
    decided = {dim.number: _decided(dim, alone) if kind == "auto" else _declared(dim, kind) for dim in dimensions}
    kinds = [each for each in KINDS if each in {kind for kind, _ in decided.values()}]
    for each in kinds:
        alike = [dim for dim in dimensions if decided[dim.number][0] == each]
        name = each if spec is None else spec.name if len(kinds) == 1 else f"{spec.name} {each}"
        if each == "categorical":
            yield from (replace(part, why=decided[part.dims[0]][1]) for part in _actions(alike, place, name))
            continue
        exact = {dim.number: _exact(dim, place, spec) for dim in alike if each == "hurdle"}
        for own in _at_once(alike, exact) if exact else [alike]:
            low, high = (), ()
            if each != "gaussian":
                ends = [_ends(dim, each, place, spec, exact.get(dim.number)) for dim in own]
                low, high = zip(*ends, strict=True)
            why = "; ".join(dict.fromkeys(decided[dim.number][1] for dim in own))
            numbers = tuple(dim.number for dim in own)
            rests = tuple(exact[number] for number in numbers if exact)
            yield ControlPart(name, numbers, each, low, high, why=why, exact=rests)


def _at_once(dimensions: Sequence[ControlDimension], exact: Mapping[int, float]) -> list[list[ControlDimension]]:
    """The dimensions in groups that are at their values in the same steps, as far as those are the commonest inside."""
    groups: list[list[ControlDimension]] = []
    for dim in dimensions:
        rests = exact[dim.number] == dim.inside
        own = next((own for own in groups if rests and dim.number in own[0].together), None)
        if own is None or exact[own[0].number] != own[0].inside:
            groups.append([dim])
        else:
            own.append(dim)
    return groups


def _exact(dim: ControlDimension, place: str, spec: PartSpec | None) -> float:
    """The value of a ``hurdle`` dimension as the demonstrations have it: a spec may round it as float32 does."""
    if spec is None or spec.value is None:
        if dim.inside is None:
            raise SpecError(
                f"{place}.kind: control dimension {dim.number} is at no value inside its range in "
                f"{100 * ATOM:g} % of the steps; it is no hurdle"
            )
        return dim.inside
    for known in (dim.inside, dim.minimum, dim.maximum):
        if known is not None and np.float32(known) == np.float32(spec.value):
            return known
    raise SpecError(
        f"{place}.value: control dimension {dim.number} is hardly ever exactly {number(spec.value)} in the "
        "demonstrations" + (f"; it is {dim.atom}" if dim.atom else "")
    )


def _decided(dimension: ControlDimension, alone: bool) -> tuple[str, str]:
    """The kind of a dimension, and why.

    :param alone: whether it is the only one.
    """
    if dimension.values:
        return "binary", f"takes two values, {number(dimension.minimum)} and {number(dimension.maximum)}"
    if dimension.discrete:
        return "categorical", f"takes {len(dimension.distinct)} values of an integer type"
    if alone and dimension.whole:
        return "categorical", f"takes {len(dimension.distinct)} whole numbers and is the only dimension"
    if dimension.atom:
        return "hurdle", dimension.atom + ("; often at an extreme" if dimension.extremes else "")
    if dimension.extremes:
        return "clipped", "often exactly at an extreme"
    return "gaussian", "varies freely"


def _declared(dimension: ControlDimension, kind: str) -> tuple[str, str]:
    """A kind that the spec asks for, and what the likelihood is worth where a value has a density without limit."""
    if not dimension.atom or kind not in ("gaussian", "clipped"):
        return kind, "as declared"
    return kind, f"as declared; {dimension.atom}, and options gain by collecting these steps, without any skill"


def _ends(
    dim: ControlDimension, kind: str, place: str, spec: PartSpec | None, exact: float | None
) -> tuple[float, float]:
    if kind == "binary":
        if len(dim.values) != 2:
            raise SpecError(f"{place}.kind: control dimension {dim.number} takes more than two values; it is no switch")
        return dim.minimum, dim.maximum
    if spec is not None and spec.bounds is not None:
        low, high = spec.bounds
        if dim.minimum < low or dim.maximum > high:
            raise SpecError(
                f"{place}.bounds: control dimension {dim.number} goes from {number(dim.minimum)} to "
                f"{number(dim.maximum)} in the demonstrations, beyond these bounds"
            )
        return low, high
    often = {name: value for name, value, _ in dim.extremes if value != exact}
    if kind == "clipped" and not often:
        often = {"minimum": dim.minimum, "maximum": dim.maximum}
    return often.get("minimum", -math.inf), often.get("maximum", math.inf)


def _actions(dimensions: Sequence[ControlDimension], place: str, name: str) -> Iterator[ControlPart]:
    """A part for each of these dimensions, whose values are the actions."""
    for dim in dimensions:
        if not dim.distinct:
            raise SpecError(f"{place}.kind: control dimension {dim.number} takes more than {MOST_DISTINCT} values")
        if len(dimensions) > 1 and not all(value.is_integer() for value in dim.distinct):
            raise SpecError(
                f"{place}.kind: control dimension {dim.number} is not of whole numbers: discrete actions are such "
                "dimensions, or rows with a single 1"
            )
        own = name if len(dimensions) == 1 else f"{name} {dim.number}"
        why = f"{len(dim.distinct)} discrete actions"
        yield ControlPart(own, (dim.number,), "categorical", values=dim.distinct, why=why)


def _rows(dimensions: Sequence[ControlDimension], name: str) -> ControlPart:
    """One part, whose actions are rows with a single 1."""
    dims = tuple(dim.number for dim in dimensions)
    return ControlPart(name, dims, "categorical", why=f"{len(dims)} discrete actions, as rows")
