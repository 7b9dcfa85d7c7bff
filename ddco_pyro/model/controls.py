"""The control dimensions in the model: their scaling, their emissions, and their standard deviations."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from ddco_pyro.data.controls import ControlPart, same
from ddco_pyro.data.demonstration import number
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.model.emissions import KINDS, Emission, Given, Product
from ddco_pyro.spec import ControlSpec, LearnedStd

ABOVE_FLOOR = 1e-4
"""A learned σ stays so far above its floor."""

INITIAL_STD = 0.5
"""Initial value of a learned standard deviation, in scaled units."""


class ControlScaling(nn.Module):
    """The map between a control [A] in its own units and the A' dimensions of it in the model, in scaled
    units.

    A continuous dimension is z = (a - shift) / scale, a switch 0 or 1, a discrete action its index. A hurdle
    is 0 at its value and nowhere else; its spread is that of the other steps. Constant dimensions are outside
    the model. Constant values, bounds, and the values of switches and hurdles are emitted exactly.

    With ``control.relative_to`` a control is relative to an observation wherever it is scaled.

    :param size: A.
    :param constant: the constant dimensions and their values, in the control's own units.
    :param parts: the kinds of the other dimensions.
    :ivar counts: how many parameters each part has (:class:`ControlStd`).
    :ivar stds: what the spec says of the σ of each continuous dimension, part after part.
    """

    shift: Tensor
    scale: Tensor
    varying: Tensor
    constant: Tensor
    order: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self, spec: ControlSpec, size: int, constant: dict[int, float], parts: tuple[ControlPart, ...]
    ) -> None:
        super().__init__()
        self.parts, self.relative_to = parts, spec.relative_to
        self.counts = [len(part.dims) * part.continuous for part in parts]
        given = {dimension: part.std for part in spec.parts for dimension in part.dims}
        self.stds = [given.get(dim) or spec.std for part in parts if part.continuous for dim in part.dims]
        varying = [dimension for dimension in range(size) if dimension not in constant]
        self.groups = [tuple(varying.index(dimension) for dimension in part.dims) for part in parts]
        count = len(varying)
        shift, scale = np.zeros(count), np.ones(count)
        low, high = np.full(count, -math.inf), np.full(count, math.inf)
        for dims, part in zip(self.groups, parts, strict=True):
            places = list(dims)
            if part.low:
                low[places], high[places] = part.low, part.high
            if part.exact:
                shift[places] = part.exact
            elif part.low and not part.continuous:
                shift[places], scale[places] = low[places], high[places] - low[places]
        order = np.argsort([*varying, *sorted(constant)]).tolist()  # Tensor.argsort on "meta" imports sympy
        for name, values in (("shift", shift), ("scale", scale), ("low", low), ("high", high)):
            self.register_buffer(
                name, torch.tensor(values.tolist(), dtype=torch.float64), name in ("shift", "scale")
            )
        self.register_buffer("varying", torch.tensor(varying, dtype=torch.int64))
        self.register_buffer(
            "constant", torch.tensor([constant[d] for d in sorted(constant)], dtype=torch.float64)
        )
        self.register_buffer("order", torch.tensor(order), persistent=False)

    @property
    def size(self) -> int:
        """A, the number of control dimensions, constant ones among them."""
        return len(self.order)

    @property
    def numbers(self) -> int:
        """How many numbers a network gives for a caller's control, without those of a σ."""
        return sum(KINDS[part.kind].size(part) for part in self.parts)

    @property
    def continuous(self) -> list[int]:
        """The dimensions, of A', that have a σ, part after part."""
        both = zip(self.groups, self.parts, strict=True)
        return [dimension for dims, part in both if part.continuous for dimension in dims]

    def fit(self, demonstrations: Demonstrations) -> None:
        """Take mean and spread of the continuous dimensions from these demonstrations' controls."""
        rows = np.concatenate([self._exactly(demo.controls(self.relative_to)) for demo in demonstrations])
        shift, spread = rows.mean(0), rows.std(0)
        for dims, part in zip(self.groups, self.parts, strict=True):
            places = list(dims)
            if part.exact:
                free = rows[(rows[:, places] != part.exact).any(1)][:, places]
                shift[places], spread[places] = part.exact, free.std(0) if len(free) else 1.0
            if part.continuous:
                self.shift[places] = torch.as_tensor(shift[places])
                self.scale[places] = torch.as_tensor(np.where(spread > 1e-9, spread, 1.0)[places])

    def scaled(self, actions: np.ndarray) -> np.ndarray:
        """[T, A] in the control's units to [T, A'] in scaled units; NaN for an unknown discrete action."""
        scaled: np.ndarray = (self._exactly(actions) - self.shift.numpy()) / self.scale.numpy()
        for dims, part in zip(self.groups, self.parts, strict=True):
            if part.values:
                given, values = actions[:, part.dims[0]], np.array(part.values)
                index = np.searchsorted(values, given).clip(max=len(values) - 1)
                scaled[:, dims[0]] = np.where(values[index] == given, index, np.nan)
        return scaled

    def _exactly(self, actions: np.ndarray) -> np.ndarray:
        """The varying dimensions [T, A'], exactly at bounds and exact values that they miss by rounding."""
        rows = np.array(actions[:, self.varying.numpy()], dtype=np.float64)
        for dims, part in zip(self.groups, self.parts, strict=True):
            for known in filter(None, (part.low, part.high, part.exact)):
                own = rows[:, list(dims)]
                rows[:, list(dims)] = np.where(same(own, np.array(known)), known, own)
        return rows

    def impossible(self, name: str, actions: np.ndarray) -> str:
        """The first control of probability 0 among ``actions`` [T, A], in words; empty without one.

        :param name: of the demonstration.
        """
        scaled = self.scaled(actions)
        for dims, part in zip(self.groups, self.parts, strict=True):
            allowed = KINDS[part.kind].possible(part, scaled[:, list(dims)])
            if not allowed.all():
                step, place = np.argwhere(~allowed)[0]
                value = actions[step, part.dims[place]]
                return (
                    f"{name}: control dimension {part.dims[place]} is {number(value)} at step "
                    f"{step}, which {part.name} ({part.kind}) cannot be"
                )
        return ""

    def emitted(self, scaled: Tensor) -> Tensor:
        """[..., A'] in scaled units to [..., A] in the control's own units, constant dimensions included."""
        values = scaled.double() * self.scale + self.shift
        low, high = self.ends()
        values = torch.where(scaled.float() <= low, self.low, values)
        values = torch.where(scaled.float() >= high, self.high, values)
        for dims, part in zip(self.groups, self.parts, strict=True):
            if part.values:
                actions = torch.tensor(part.values, dtype=torch.float64)[scaled[..., dims[0]].long()]
                values = torch.where(torch.arange(values.shape[-1]) == dims[0], actions.unsqueeze(-1), values)
        return torch.cat([values, self.constant.expand(*values.shape[:-1], -1)], dim=-1)[..., self.order]

    def ends(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds in scaled units, float32 [A'], infinite where there are none."""
        return ((self.low - self.shift) / self.scale).float(), ((self.high - self.shift) / self.scale).float()

    def emission(self, numbers: Tensor, std: Tensor) -> Emission:
        """The emission of a network's numbers [..., K, size].

        :param std: the parameters of the parts, one part after the other, [C], [K, C] or [..., K, C].
        """
        groups: list[tuple[tuple[int, ...], Emission]] = []
        sizes, at, ends = [KINDS[part.kind].size(part) for part in self.parts], 0, self.ends()
        each = numbers.split(sizes, dim=-1) if len(sizes) > 1 else (numbers,)  # a split's gradient is a copy
        for dims, part, own, count in zip(self.groups, self.parts, each, self.counts, strict=True):
            places = slice(None) if dims == (*range(len(self.varying)),) else list(dims)  # lists are copied
            units, low, high = (of[places] for of in (self.scale.log(), *ends))
            given = Given(part, own, std[..., at : at + count], units, low, high)
            groups.append((dims, KINDS[part.kind].of(given)))
            at += count
        in_order = [dimension for dims, _ in groups for dimension in dims] == list(range(len(self.varying)))
        return groups[0][1] if len(groups) == 1 and in_order else Product(tuple(groups))


def raw_of(std: Tensor, floor: Tensor) -> Tensor:
    """The parameters of a learned σ = floor + softplus(raw)."""
    return (std - floor).clamp(min=ABOVE_FLOOR).expm1().log()


class ControlStd(nn.Module):
    """The standard deviations σ of a caller's continuous dimensions, in scaled units: fixed, or learned above
    a floor.

    Those of one part come after those of the other.

    The options of a level share a σ unless the spec says ``per_option``: with its own σ an option can collect
    the steps where a Gaussian control hardly varies, as on a bound, whatever the skill (docs/decisions.md).
    With ``per_state`` σ = floor + softplus(y + start), where y is a number of the caller's network.

    :ivar of_state: the dimensions whose σ depends on the state.
    """

    fixed: Tensor
    floor: Tensor
    start: Tensor

    def __init__(self, scaling: ControlScaling, copies: int) -> None:
        super().__init__()
        each = scaling.stds
        stds = {place: std for place, std in enumerate(each) if isinstance(std, LearnedStd)}
        self.own = [place for place, std in stds.items() if std.per_option]
        self.of_state = [place for place, std in stds.items() if std.per_state]
        self.shared = [place for place in stds if place not in (*self.own, *self.of_state)]
        fixed = [0.0 if isinstance(std, LearnedStd) else std for std in each]
        floor = [std.floor if isinstance(std, LearnedStd) else 0.0 for std in each]
        self.register_buffer("fixed", torch.tensor(fixed), persistent=False)
        self.register_buffer("floor", torch.tensor(floor), persistent=False)
        start = [math.log(math.expm1(max(INITIAL_STD - least, 1e-3))) for least in floor]
        self.register_buffer("start", torch.tensor(start), persistent=False)
        if self.shared:
            self.raw = nn.Parameter(torch.tensor([start[place] for place in self.shared]))
        if self.own:
            self.raw_own = nn.Parameter(torch.tensor([[start[place] for place in self.own]] * copies))

    def table(self) -> Tensor:
        """σ without the dimensions whose σ depends on the state: [C]; [K, C] with a σ of each option."""
        std = self.fixed
        if self.shared:
            std = _with_columns(std, self.shared, self.floor[self.shared] + softplus(self.raw))
        if self.own:
            std = _with_columns(std, self.own, self.floor[self.own] + softplus(self.raw_own))
        return std

    def forward(self, numbers: Tensor | None = None, table: Tensor | None = None) -> Tensor:
        """σ [C]; [K, C] with a σ of each option; [..., K, C] with a σ that depends on the state.

        :param numbers: y of each dimension in ``of_state``, [..., K, S]; None without such a dimension.
        :param table: the result of :meth:`table`, if it is known.
        """
        std = self.table() if table is None else table
        if self.of_state:
            assert numbers is not None  # the caller's network gives them
            floor, start = self.floor[self.of_state], self.start[self.of_state]
            std = _with_columns(std, self.of_state, floor + softplus(numbers + start))
        return std


def _with_columns(table: Tensor, places: Sequence[int], values: Tensor) -> Tensor:
    """A table [C] or [K, C] with values [..., S] at S of its places, [..., C]."""
    if len(places) == table.shape[-1]:
        return values
    columns = list(table.expand(*values.shape[:-1], -1).unbind(-1))
    for place, column in zip(places, values.unbind(-1), strict=True):
        columns[place] = column
    return torch.stack(columns, dim=-1)
