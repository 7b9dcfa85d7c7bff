"""Controls: statistics of each dimension over demonstrations, and the kind of distribution that each gets."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, get_args

import numpy as np

from ddco_pyro.data.demonstration import number
from ddco_pyro.spec import DISCRETE, ControlSpec, Kind, SpecError

OFTEN = 0.01
"""A dimension often equals an extreme if more than this share of the steps does."""

ATOM = 0.05
"""A dimension has an atom inside its range if at least this share of the steps equals one value there."""

FEWEST = 3
"""Fewest steps of an atom: rounded numbers coincide now and then."""

FEW = 0.1
"""What at most this share of the demonstrations makes, or a single one, decides no kind."""

TOGETHER = 0.9
"""Two dimensions rest together if this share of the steps in which either rests is shared."""

ROUNDING = 4 * float(np.finfo(np.float32).eps)
"""Two values are the same if they differ by at most this part of one of them."""

MOST_DISTINCT = 64
"""Most distinct values of a dimension that are kept."""

MOST_DIMENSIONS = 256
"""Largest control in which common values are looked for."""


def same(values: np.ndarray, value: np.ndarray | float) -> np.ndarray:
    """Which values equal a finite ``value`` within rounding. Only 0 equals 0."""
    with np.errstate(invalid="ignore", over="ignore"):
        found: np.ndarray = np.isfinite(value) & (np.abs(values - value) <= ROUNDING * np.abs(value))
    return found


RESOLUTION = 1e-9
"""A dimension is treated as constant if its range is below RESOLUTION × its largest magnitude, or for coarser
types :data:`LAST_PLACES` units in the last place."""

LAST_PLACES = 4

SETTLED = 256 * float(np.finfo(np.float32).eps)
"""A dimension is treated as constant if its range is below SETTLED (3e-5) × the observation's largest
magnitude, at most 1. Simulators round all components of a vector alike in every step: components of a
quaternion at rest vary by 6e-7 to 1.6e-5 in Meta-World's files. The bound of 1 is for mixed units, where one
dimension may be in the thousands."""


def rounding(low: np.ndarray, high: np.ndarray, dtype: np.dtype[Any]) -> np.ndarray:
    """The largest range of each dimension that counts as rounding, [D]; wider dimensions vary.

    :param low: the smallest value of each dimension of an observation [D]; ``high`` the largest. Values that
        are not finite give NaN.
    :param dtype: the type of the values in the file; whole numbers are not rounded.
    """
    sizes = np.maximum(np.abs(np.asarray(low, np.float64)), np.abs(np.asarray(high, np.float64)))
    finite = np.isfinite(sizes)
    if dtype.kind != "f":
        return np.where(finite, 0.0, np.nan)
    own = max(RESOLUTION, LAST_PLACES * float(np.finfo(dtype).eps)) * np.maximum(sizes, RESOLUTION)
    largest = min(1.0, float(sizes.max(initial=0.0, where=finite)))
    return np.where(finite, np.maximum(own, SETTLED * largest), np.nan)


@dataclass(frozen=True)
class ControlDimension:
    """Statistics of one control dimension over all steps of some demonstrations.

    :param number: index of the dimension, from 0.
    :param minimum: the smallest value, in the control's units; ``maximum`` likewise.
    :param at_minimum: steps at the minimum within rounding (:data:`ROUNDING`); ``at_maximum`` likewise.
    :param steps: number of steps with finite values.
    :param distinct: the sorted values if there are at most :data:`MOST_DISTINCT`; else empty.
    :param inside: the commonest value strictly between the extremes; None without a common value.
    :param at_inside: number of steps that equal ``inside``.
    :param together: other dimensions that equal their ``inside`` in the same steps (:data:`TOGETHER`).
    :param integer: whether the controls have an integer type.
    :param made_by: for ``minimum``, ``maximum`` and ``inside``: names of the few demonstrations (:data:`FEW`)
        without which the value would be rare. Such a value decides no kind.
    :param exceptions: names of the few demonstrations without which it would be constant or a switch.
    """

    number: int
    minimum: float
    maximum: float
    at_minimum: int
    at_maximum: int
    steps: int
    distinct: tuple[float, ...] = ()
    inside: float | None = None
    at_inside: int = 0
    together: tuple[int, ...] = ()
    integer: bool = False
    made_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    exceptions: tuple[str, ...] = ()

    @property
    def discrete(self) -> bool:
        """Whether the values are few and of an integer type."""
        return self.integer and bool(self.distinct)

    @property
    def constant(self) -> bool:
        """Whether all steps have the same value."""
        return bool(same(np.array(self.minimum), self.maximum))

    @property
    def values(self) -> tuple[float, ...]:
        """The values if there are one or two; else empty."""
        if self.constant:
            return (self.minimum,)
        return (self.minimum, self.maximum) if self.at_minimum + self.at_maximum == self.steps else ()

    @property
    def extremes(self) -> tuple[tuple[str, float, float], ...]:
        """(``minimum`` or ``maximum``, its value, share of steps that equal it) for extremes that are common.

        Empty for discrete dimensions and for one or two values. An extreme that occurs once does not count,
        nor one that few demonstrations make.
        """
        if self.values or self.discrete:
            return ()
        ends = (("minimum", self.minimum, self.at_minimum), ("maximum", self.maximum, self.at_maximum))
        often = [end for end in ends if end[2] > max(1, OFTEN * self.steps) and end[0] not in self.made_by]
        return tuple((name, value, at / self.steps) for name, value, at in often)

    @property
    def atom(self) -> str:
        """The atom inside the range and its share of the steps, in words; empty without an atom."""
        rare = self.at_inside < max(FEWEST, ATOM * self.steps) or "inside" in self.made_by
        if self.inside is None or self.discrete or rare:
            return ""
        return f"exactly {number(self.inside)} in {100 * self.at_inside / self.steps:.1f} % of the steps"

    @property
    def made(self) -> str:
        """The values that few demonstrations make, in words; empty without any."""
        if self.values or self.discrete:
            return ""
        each = ((getattr(self, end), names) for end, names in self.made_by.items())
        common = [f"{number(value)} is common in {few(names)} alone" for value, names in each]
        switch = [f"a switch without {few(self.exceptions)}"] if self.exceptions else []
        return "; ".join([*common, *switch])

    @property
    def note(self) -> str:
        """What is unusual about the dimension, in a few words; may be empty."""
        if self.constant:
            return f"constant ({number(self.minimum)}): no part of the model, emitted as it is"
        if self.values:
            return f"takes two values, {number(self.minimum)} and {number(self.maximum)}"
        shares = [f"{name} {number(value)} in {100 * share:.1f} %" for name, value, share in self.extremes]
        ends = ", at its ".join(f"{share} of the steps" for share in shares)
        return "; ".join(filter(None, (self.atom, ends and f"exactly at its {ends}", self.made)))

    def as_data(self) -> dict[str, Any]:
        left_out = ("distinct", "together", "integer", "made_by", "exceptions")
        return {key: value for key, value in asdict(self).items() if key not in left_out}


def few(names: Sequence[str]) -> str:
    """``demo_3``, or ``demo_1, demo_2, demo_3, ...`` of more."""
    return ", ".join(names[:3]) + ", ..." * (len(names) > 3)


class _Steps:
    """The values of one dimension over all steps [T]; ``starts`` [N] are the first steps of demonstrations.

    ``low``, ``high``, ``at_low``, ``at_high`` and ``steps`` are the statistics of each demonstration, [N].
    """

    def __init__(self, values: np.ndarray, starts: np.ndarray, names: Sequence[str]) -> None:
        self.values, self.starts, self.names = values, starts, names
        finite = np.isfinite(values)
        self.low = np.minimum.reduceat(np.where(finite, values, np.inf), starts)
        self.high = np.maximum.reduceat(np.where(finite, values, -np.inf), starts)
        lengths = np.diff(starts, append=len(values))
        self.at_low, self.at_high = (self.at(np.repeat(end, lengths)) for end in (self.low, self.high))
        self.steps = self._count(finite)
        self.distinct, self.times = np.unique(values[finite], return_counts=True)

    def _count(self, which: np.ndarray) -> np.ndarray:
        return np.add.reduceat(which, self.starts, dtype=np.int64)

    def at(self, value: np.ndarray | float) -> np.ndarray:
        """Number of steps at a value in each demonstration [N]."""
        return self._count(same(self.values, value))

    def made_by(self, value: float, often: float, least: int) -> tuple[str, ...]:
        """The few demonstrations without which a value is rare.

        :param often: share of the steps from which on the value is common.
        :param least: steps with which a demonstration has the value by more than chance.
        :returns: their names; empty where the value is rare with them, or common without them.
        """
        at = self.at(value)
        makes = at >= least
        common = at.sum() >= max(2, often * self.steps.sum()) and makes.sum() <= most_few(len(at))
        made = common and at[~makes].sum() < often * max(self.steps[~makes].sum(), 1)
        return tuple(self.names[place] for place in np.flatnonzero(makes & made).tolist())

    def exceptions(self) -> tuple[str, ...]:
        """The few demonstrations without which the dimension would be constant or a switch."""
        two = (self.at_low + self.at_high == self.steps) | same(self.low, self.high)
        values, times = np.unique(np.concatenate([self.low[two], self.high[two]]), return_counts=True)
        commonest = values[np.argsort(-times, kind="stable")]
        for count in (1, 2):
            at = [[same(end, value) for end in (self.low, self.high)] for value in commonest[:count]]
            outside = np.flatnonzero(~(two & np.any(at, axis=0).all(0)) & (self.steps > 0))
            if len(commonest) >= count and len(outside) <= most_few(len(self.steps)):
                return tuple(self.names[place] for place in outside.tolist())
        return ()

    def inside(self) -> float | None:
        """The commonest value between the extremes; one that few demonstrations make comes last."""
        often = self.times >= max(FEWEST, ATOM * len(self.values))
        ends = np.array([self.low.min(), self.high.max()])
        common = (self.distinct[often] + 0.0).tolist()  # no minus 0
        values = [value for value in common if not same(ends, value).any()]
        key = {one: (bool(self.made_by(one, ATOM, FEWEST)), -int(self.at(one).sum())) for one in values}
        return min(values, key=key.__getitem__, default=None)


def control_dimensions(controls: Mapping[str, np.ndarray]) -> tuple[ControlDimension, ...]:
    """The statistics of each dimension in the controls [T, A] of demonstrations by name.

    NaN and infinite values are ignored, and so are dimensions without other values.
    """
    names = [name for name, steps in controls.items() if len(steps)]
    if not names:
        return ()
    integer = all(steps.dtype.kind in "iu" for steps in controls.values())
    starts = np.cumsum([0, *(len(controls[name]) for name in names)])
    flat = [controls[name].reshape(len(controls[name]), -1) for name in names]
    rows = np.concatenate(flat).astype(np.float64)
    dimensions: dict[int, ControlDimension] = {}
    rests: dict[int, np.ndarray] = {}
    for index, values in enumerate(rows.T):
        steps = _Steps(np.ascontiguousarray(values), starts[:-1], names)
        if not steps.steps.any():
            continue
        low, high = float(steps.low.min()), float(steps.high.max())
        inside = steps.inside() if rows.shape[1] <= MOST_DIMENSIONS else None
        made = {"minimum": steps.made_by(low, OFTEN, 1), "maximum": steps.made_by(high, OFTEN, 1)}
        if inside is not None:
            made["inside"] = steps.made_by(inside, ATOM, FEWEST)
            rests[index] = same(values, inside)
        dimensions[index] = ControlDimension(
            index,
            low,
            high,
            at_minimum=int(steps.at(low).sum()),
            at_maximum=int(steps.at(high).sum()),
            steps=int(steps.steps.sum()),
            distinct=tuple(steps.distinct.tolist()) if len(steps.distinct) <= MOST_DISTINCT else (),
            inside=inside,
            at_inside=int(rests[index].sum()) if index in rests else 0,
            integer=integer,
            made_by={end: makers for end, makers in made.items() if makers},
            exceptions=steps.exceptions(),
        )
    for index, rest in rests.items():
        together = (
            other for other, resting in rests.items()
            if other != index and (rest & resting).sum() >= TOGETHER * (rest | resting).sum()
        )  # fmt: skip
        dimensions[index] = replace(dimensions[index], together=tuple(together))
    return tuple(dimensions.values())


def most_few(number: int) -> int:
    """The largest number of demonstrations, of so many, that are few (:data:`FEW`)."""
    return max(1, int(FEW * number)) if number > 2 else 0


def all_constant(dimensions: Sequence[ControlDimension]) -> str:
    """The problem with controls that never vary, in words."""
    values = ", ".join([number(dim.minimum) for dim in dimensions[:5]] + ["..."] * (len(dimensions) > 5))
    constant = f"every dimension is constant ({values}) in all demonstrations"
    return f"actions: {constant}, so there is no control to model"


def notes(dimensions: Iterable[ControlDimension]) -> list[str]:
    """A line for each unusual dimension."""
    return [f"control dimension {dim.number}: {dim.note}" for dim in dimensions if dim.note]


# --- kinds of distribution ----------------------------------------------------------------------------------

KINDS = tuple(kind for kind in get_args(Kind) if kind != "auto")
BOUNDED = ("clipped", "hurdle")


@dataclass(frozen=True)
class ControlPart:
    """Control dimensions whose distribution is of one kind.

    The dimensions of a ``hurdle`` part share one probability: that all of them equal their ``exact`` values.

    :param dims: indices of the control dimensions; constant dimensions belong to no part.
    :param kind: one of :data:`KINDS`.
    :param low: for each dimension, in the control's units: the lower bound (-inf for none) of a ``clipped``
        or ``hurdle`` part, the lower value of a ``binary`` part; ``high`` likewise. Empty for other kinds.
    :param values: the actions of a one-dimensional ``categorical`` part.
    :param exact: the value of each ``hurdle`` dimension that has a probability; empty for other kinds.
    :param why: the reason for the kind, in words.
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
        """Whether the distribution has a σ."""
        return self.kind not in DISCRETE

    @property
    def bounded(self) -> bool:
        """Whether the part is continuous with a finite bound."""
        return self.continuous and any(map(math.isfinite, (*self.low, *self.high)))

    def as_data(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of(cls, data: dict[str, Any]) -> ControlPart:
        """The part that :meth:`as_data` gave."""
        lists = {key: tuple(value) for key, value in data.items() if isinstance(value, list)}
        return cls(**{**data, **lists})


def described(parts: Sequence[ControlPart]) -> list[str]:
    """A line for each part: dimensions, kind, and reason."""
    return [f"control {listed(one.dims)}: {one.kind}" + (f" ({one.why})" if one.why else "") for one in parts]


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
    """The reference measure of a log-likelihood by dimension. Log-likelihoods compare only under equal ones.

    Each entry is the kind, followed by the bounds of a ``clipped`` dimension (None for no bound) or the
    values of a discrete dimension. For ``hurdle``: bounds, exact value, and the dimensions of the part.
    """
    dimensions: dict[str, list[Any]] = {}
    for part in parts:
        for place, dimension in enumerate(part.dims):
            ends = [part.low[place], part.high[place]] if part.low else []
            about = [end if math.isfinite(end) else None for end in ends] or list(part.values)
            exact = [part.exact[place], list(part.dims)] if part.exact else []
            kind = "gaussian" if part.continuous and not about else part.kind  # any density of the whole line
            dimensions[str(dimension)] = [kind, *about, *exact]
    return dimensions


def difference(ours: Sequence[ControlPart], theirs: Sequence[ControlPart]) -> str:
    """The first control dimension in which two measures differ, in words; empty if the measures are equal."""
    first, second = measure(ours), measure(theirs)
    for dimension in sorted(set(first) | set(second), key=int):
        if first.get(dimension) != second.get(dimension):
            one, other = (_measured(each.get(dimension)) for each in (first, second))
            return f"control dimension {dimension} is {one} in one and {other} in the other"
    return ""


def _measured(measured: Sequence[Any] | None) -> str:
    if measured is None:
        return "no part of the likelihood"
    kind, *about = measured
    ends = " and ".join("none" if end is None else number(end) for end in about[:2])
    text = f"{kind} with bounds {ends}" if kind in BOUNDED else str(kind)
    return f"{text} at {number(about[2])}, of {listed(about[3])}" if kind == "hurdle" else text


def all_gaussian(varying: Sequence[int]) -> tuple[ControlPart, ...]:
    """One Gaussian part of these dimensions: the model before any demonstrations are known."""
    return (ControlPart("gaussian", tuple(varying), "gaussian"),)


def control_parts(spec: ControlSpec, dimensions: Sequence[ControlDimension]) -> tuple[ControlPart, ...]:
    """The parts of a control: the parts of the spec, then all other varying dimensions by kind.

    :raises SpecError: the spec does not fit the demonstrations.
    """
    refuse_unknown_dimensions(spec, len(dimensions))
    varying = {dim.number: dim for dim in dimensions if not dim.constant}
    named = []
    for place, part in enumerate(spec.parts):
        own = [varying.pop(dimension) for dimension in part.dims if dimension in varying]
        named += list(_parts(part.kind, own, f"control.parts.{place}", part.name))
    return (*named, *_parts(spec.kind, list(varying.values()), "control", ""))


def refuse_unknown_dimensions(spec: ControlSpec, size: int) -> None:
    """Refuse a spec that names a dimension beyond a control of this size.

    :raises SpecError: it does.
    """
    for place, part in enumerate(spec.parts):
        if unknown := [dimension for dimension in part.dims if dimension >= size]:
            problem = f"there is no control dimension {unknown[0]}; the control has {size}, counted from 0"
            raise SpecError(f"control.parts.{place}.dims: {problem}")


def _parts(declared: str, dims: Sequence[ControlDimension], place: str, name: str) -> Iterator[ControlPart]:
    """One part for each kind among the dimensions.

    :param place: key path of the spec, for errors.
    :param name: of the part in the spec; empty for all other dimensions.
    """
    decided = {dim.number: _kind(dim, declared, len(dims) == 1) for dim in dims}
    kinds = [kind for kind in KINDS if kind in {kind for kind, _ in decided.values()}]
    for kind in kinds:
        alike = [dim for dim in dims if decided[dim.number][0] == kind]
        called = kind if not name else name if len(kinds) == 1 else f"{name} {kind}"
        groups = [[dim] for dim in alike] if kind == "categorical" else [alike]
        for own in _resting_together(alike, place) if kind == "hurdle" else groups:
            ended = own if kind in (*BOUNDED, *DISCRETE) else ()
            bounds = [_ends(dim, kind, place, len(alike) == 1) for dim in ended]
            yield ControlPart(
                called if kind != "categorical" or len(groups) == 1 else f"{called} {own[0].number}",
                tuple(dim.number for dim in own),
                kind,
                tuple(low for low, _ in bounds) if kind != "categorical" else (),
                tuple(high for _, high in bounds) if kind != "categorical" else (),
                own[0].distinct if kind == "categorical" else (),
                "; ".join(dict.fromkeys(decided[dim.number][1] for dim in own)),
                tuple(dim.inside or 0.0 for dim in own) if kind == "hurdle" else (),
            )


def _kind(dim: ControlDimension, declared: str, alone: bool) -> tuple[str, str]:
    """The kind of a dimension, and the reason: declared by the spec, or decided under ``auto``.

    :param alone: whether there is no other dimension.
    """
    if declared == "categorical":
        return declared, f"{len(dim.distinct)} discrete actions"
    if declared != "auto":
        unbounded = dim.atom and declared not in ("hurdle", *DISCRETE)
        warning = f"; {dim.atom}, and options gain by collecting these steps, without any skill"
        return declared, "as declared" + (warning if unbounded else "")
    kind, why = "gaussian", "varies freely"
    if dim.values:
        kind, why = "binary", dim.note
    elif dim.discrete:
        kind, why = "categorical", f"takes {len(dim.distinct)} values of an integer type"
    elif alone and dim.distinct and dim.minimum >= 0 and all(value.is_integer() for value in dim.distinct):
        kind, why = "categorical", f"takes {len(dim.distinct)} whole numbers and is the only dimension"
    elif dim.atom:
        kind, why = "hurdle", dim.atom + ("; often at an extreme" if dim.extremes else "")
    elif dim.extremes:
        kind, why = "clipped", "often exactly at an extreme"
    return kind, "; ".join(filter(None, (why, dim.made)))


def _resting_together(dimensions: Sequence[ControlDimension], place: str) -> list[list[ControlDimension]]:
    """Groups of dimensions that equal their commonest inside values in the same steps."""
    groups: list[list[ControlDimension]] = []
    for dim in dimensions:
        if dim.inside is None:
            rare = f"is at no value inside its range in {100 * ATOM:g} % of the steps; it is no hurdle"
            raise SpecError(f"{place}.kind: control dimension {dim.number} {rare}")
        if (own := next((own for own in groups if dim.number in own[0].together), None)) is None:
            groups.append([dim])
        else:
            own.append(dim)
    return groups


def _ends(dim: ControlDimension, kind: str, place: str, alone: bool) -> tuple[float, float]:
    """The bounds of a dimension, or its extreme values where it is discrete."""
    what = f"{place}.kind: control dimension {dim.number}"
    if kind == "categorical" and not dim.distinct:
        raise SpecError(f"{what} takes more than {MOST_DISTINCT} values")
    if kind == "categorical" and not alone and not all(value.is_integer() for value in dim.distinct):
        raise SpecError(f"{what} is not of whole numbers: no discrete action")
    if kind == "binary" and len(dim.values) != 2:
        raise SpecError(f"{what} takes more than two values; it is no switch")
    if kind in DISCRETE:
        return dim.minimum, dim.maximum
    often = {name: value for name, value, _ in dim.extremes}
    if kind == "clipped" and not often:
        often = {"minimum": dim.minimum, "maximum": dim.maximum}
    return often.get("minimum", -math.inf), often.get("maximum", math.inf)
