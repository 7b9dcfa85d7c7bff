"""What is the same where it should not be: padded ends, copied demonstrations, controls that are observed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ddco_pyro.data.checks import divided
from ddco_pyro.data.control_dimensions import number
from ddco_pyro.data.control_parts import listed
from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources import Column
from ddco_pyro.data.values import NUMBERS

LOOKED_AT = 1000
"""Steps of each demonstration in which observations are compared with controls."""

WIDEST = 10_000
"""Numbers of an observation's step, at most, that are compared with controls."""

FEW = 3
"""Values of a switch, or of one that is padded."""

SHIFTS = {0: "at the same step", 1: "of the next step", -1: "of the step before"}
"""By how many steps a control is ahead of the observation that it equals."""


@dataclass
class _Demonstration:
    """What is gathered of one demonstration.

    :param tails: of each array, the number of last steps that are the same.
    :param commands: the first controls [T, A].
    :param values: the values of each control dimension; more than :data:`FEW` are not told apart.
    :param ends: of each control dimension, the steps up to the last one that is not 0.
    :param zeros: of each control dimension, the number of steps in which it is 0.
    """

    name: str
    steps: int
    digest: bytes = b""
    tails: list[int] = field(default_factory=list)
    commands: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    values: list[frozenset[float]] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    zeros: list[int] = field(default_factory=list)

    @property
    def tail(self) -> int:
        """The number of last steps in which nothing changes."""
        return min(self.tails, default=0)

    def take(self, controls: np.ndarray, first: int) -> None:
        """Take in controls [T, A] from this step on."""
        if not first:
            self.commands = controls[:LOOKED_AT].copy()
            self.values = [frozenset()] * controls.shape[1]
            self.ends, self.zeros = [0] * controls.shape[1], [0] * controls.shape[1]
        for dimension, column in enumerate(controls.T):
            known = self.values[dimension]
            if len(known) <= FEW:
                self.values[dimension] = known | frozenset(np.unique(column)[: FEW + 1].tolist())
            (moved,) = np.nonzero(column)
            self.zeros[dimension] += len(column) - len(moved)
            if len(moved):
                self.ends[dimension] = first + int(moved[-1]) + 1


class Coincidences:
    """Gathers, demonstration by demonstration and block by block, what is the same where it should not be."""

    def __init__(self) -> None:
        self._seen: list[_Demonstration] = []
        self._equal: dict[str, np.ndarray] = {}  # by place, for each shift, [D, A]: whether they are always the same
        self._compared: dict[str, np.ndarray] = {}  # steps, for each shift

    def begin(self, name: str, steps: int) -> None:
        """Another demonstration; its controls are read first."""
        self._seen.append(_Demonstration(name, steps))

    def forget(self, name: str) -> None:
        """A demonstration that could not be read to its end."""
        self._seen = [demo for demo in self._seen if demo.name != name]

    def watched(self, place: str, column: Column) -> Column:
        """The same column, whose values are gathered when they are read."""
        if place.startswith("labels/"):
            return column
        demo = self._seen[-1]

        def blocks() -> Iterator[np.ndarray]:
            tail, first, digest = 0, 0, hashlib.sha256(place.encode())
            last = np.empty(0)
            for block in column.blocks():
                rows = block.reshape(len(block), -1)
                if len(rows) and block.dtype.kind in NUMBERS:
                    own = _tail(rows)
                    tail = own + (tail if own == len(rows) and np.array_equal(rows[0], last) else 0)
                    last = rows[-1].copy()
                    digest.update(np.ascontiguousarray(rows).tobytes())
                    if place == "actions":
                        demo.take(rows, first)
                    elif len(demo.commands) and not first and not column.image and rows.shape[1] <= WIDEST:
                        self._compare(place, rows[: len(demo.commands)], demo.commands)
                first += len(rows)
                yield block
            demo.tails.append(tail)
            demo.digest += digest.digest()

        return replace(column, blocks=blocks)

    def _compare(self, place: str, rows: np.ndarray, commands: np.ndarray) -> None:
        """Which numbers of an observation [T, D] are controls [T, A], at the same step or one beside it."""
        commands = commands[: len(rows)]
        floats = [array.dtype for array in (rows, commands) if array.dtype.kind == "f"]
        coarser = min(floats, key=lambda dtype: dtype.itemsize, default=np.dtype(np.float64))
        with np.errstate(over="ignore"):
            rows, commands = rows.astype(coarser), commands.astype(coarser)
        shape = (len(SHIFTS), rows.shape[1], commands.shape[1])
        equal = self._equal.setdefault(place, np.ones(shape, dtype=bool))
        compared = self._compared.setdefault(place, np.zeros(len(SHIFTS), dtype=int))
        for at, shift in enumerate(SHIFTS):
            own = rows[max(-shift, 0) : max(len(rows) - max(shift, 0), 0)]
            ahead = commands[max(shift, 0) :][: len(own)]
            compared[at] += len(own)
            for dimension in np.flatnonzero(equal[at].any(0)):
                equal[at, :, dimension] &= (own == ahead[:, [dimension]]).all(0)

    def notes(self, masks: Mapping[str, Sequence[str]], varying: Sequence[int]) -> list[str]:
        """A line for each kind of coincidence, with a count and the first place.

        :param varying: the control dimensions that are not constant.
        """
        return [*self._switches(varying), *self._tails(), *self._copies(masks), *self._observed(varying)]

    def leaks(self, place: str, varying: Sequence[int], still: Sequence[int]) -> bool:
        """Whether an observation holds nothing but controls that are still to come.

        :param still: its constant dimensions.
        """
        if place not in self._equal:
            return False
        found = [self._controls(place, shift, varying)[0] for shift in (0, 1)]
        rest = set(range(self._equal[place].shape[1])) - set(still)
        return bool(rest) and rest <= {*found[0], *found[1]}

    def _controls(self, place: str, shift: int, varying: Sequence[int]) -> tuple[list[int], list[int]]:
        """The dimensions of an observation that equal controls of so many steps later, and those of the controls."""
        at = list(SHIFTS).index(shift)
        if not self._compared[place][at]:
            return [], []
        equal = self._equal[place][at][:, list(varying)]
        own, controls = np.flatnonzero(equal.any(1)).tolist(), np.flatnonzero(equal.any(0)).tolist()
        return own, [varying[column] for column in controls]

    def _observed(self, varying: Sequence[int]) -> Iterator[str]:
        for place in self._equal:
            for shift, when in SHIFTS.items():
                own, controls = self._controls(place, shift, varying)
                if own:
                    effect = "tend to repeat it" if shift < 0 else "see what they have to predict"
                    yield (
                        f"{place}: {listed(own)} = control {listed(controls)} {when}, in all {len(self._seen)} "
                        f"demonstrations, the first {self._seen[0].name}: policies {effect}"
                    )

    def _tails(self) -> Iterator[str]:
        padded = [demo for demo in self._seen if demo.tail > 1]
        if len(padded) > 1:
            first = padded[0]
            yield (
                f"the last steps are the same in {len(padded)} of {len(self._seen)} demonstrations, the first "
                f"{first.name} from step {first.steps - first.tail} on: cut them off if they are padding"
            )

    def _copies(self, masks: Mapping[str, Sequence[str]]) -> Iterator[str]:
        known: dict[bytes, str] = {}
        each = [(known.setdefault(demo.digest, demo.name), demo.name) for demo in self._seen]
        pairs = [(first, again) for first, again in each if first != again]
        effect = "one of two that are the same may be trained on and the other held out"
        if masks.keys() & {"train", "valid"}:
            try:
                valid = set(divided([demo.name for demo in self._seen], masks)[1])
            except DemonstrationsError:
                return  # which is a problem of its own
            pairs = [pair for pair in pairs if (pair[0] in valid) != (pair[1] in valid)]
            effect = "one of them is trained on and the other held out"
        if pairs:
            first, again = pairs[0]
            yield (
                f"{len(pairs)} of {len(self._seen)} demonstrations equal another one, the first {again}, which equals "
                f"{first}: {effect}"
            )

    def _switches(self, varying: Sequence[int]) -> Iterator[str]:
        for dimension in varying:
            each = [demo for demo in self._seen if dimension < len(demo.values)]
            whole = frozenset[float]().union(*(demo.values[dimension] for demo in each))
            if len(whole) == FEW and 0.0 in whole:
                yield from self._padded_switch(dimension, each, whole - {0.0})
                yield from self._two_conventions(dimension, each)

    @staticmethod
    def _padded_switch(dimension: int, each: Sequence[_Demonstration], values: frozenset[float]) -> Iterator[str]:
        padded = [demo for demo in each if demo.zeros[dimension]]
        if any(demo.ends[dimension] + demo.zeros[dimension] != demo.steps for demo in padded):
            return
        low, high = map(number, sorted(values))
        yield (
            f"control dimension {dimension}: {low} or {high}, and 0 at the end of {len(padded)} of {len(each)} "
            f"demonstrations, the first {padded[0].name} from step {padded[0].ends[dimension]} on: cut the ends off if "
            "they are padding, and it is a switch"
        )

    @staticmethod
    def _two_conventions(dimension: int, each: Sequence[_Demonstration]) -> Iterator[str]:
        signs = [demo for demo in each if demo.values[dimension] == {-1.0, 1.0}]
        bits = [demo for demo in each if demo.values[dimension] == {0.0, 1.0}]
        if signs and bits and not any({-1.0, 0.0} <= demo.values[dimension] for demo in each):
            yield (
                f"control dimension {dimension}: -1 or 1 in {len(signs)} demonstrations, the first {signs[0].name}, "
                f"and 0 or 1 in {len(bits)}, the first {bits[0].name}: write all of them in one way, and it is a switch"
            )


def _tail(rows: np.ndarray) -> int:
    """The number of last rows that are the same."""
    (others,) = np.nonzero((rows != rows[-1]).any(1))
    return len(rows) - (int(others[-1]) + 1 if len(others) else 0)
