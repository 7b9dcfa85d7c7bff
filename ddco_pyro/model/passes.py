"""Compiled passes from networks' outputs to the probabilities of a step, and from posteriors to gradients of outputs.

They work on blocks of steps of four trajectories side by side: arrays [block, n, lanes]. Outputs and gradients are read
and written where torch has them, float32 or float64, whatever their strides. All arithmetic is float64.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ddco_pyro.model.elementary import (
    LANES,
    Array,
    Plane,
    absolute,
    any_of,
    apart,
    at,
    exponential,
    gather,
    gather_square,
    jit,
    lanes,
    log_normal_cdf,
    logarithm,
    number,
    put,
    record,
    scatter,
    scatter_square,
    where,
    whole,
)  # fmt: skip

TERMINATION_BOUND = 12.0
"""Termination logits lie within ±12 (ψ between 6e-6 and 1 - 6e-6), so no path's probability is ever exactly 0."""

PROBABILITIES, LOGARITHMS, SOFTMAX, TERMINATIONS, NORMAL, SWITCHES, CATEGORIES = range(7)
"""Kinds of passes. The first two take log-tables that are given."""

LAST = 3
"""The lane that is alive at every step of a lot."""


class Pass(NamedTuple):
    """A compiled pass between tensors and the columns of a link.

    :param kind: one of :data:`PROBABILITIES` and so on.
    :param callers: K.
    :param size: numbers of a caller, C.
    :param tensors: the outputs. The first is [N, T, K, C], others with more than two dimensions likewise.
    :param option: a softmax's impossible choices before the others; whether a control is a hurdle's.
    :param controls: [N, T, A]; None for kinds without.
    :param constants: of the kind, float64.
    :param kept: lanes of each step that the gradient needs.
    :param by_step: how many of the tensors, the first ones, differ from step to step.
    :param shared: lanes of a trajectory's gradients of σ, the units' logarithms and both bounds, which steps share.
    """

    kind: int
    callers: int
    size: int
    tensors: tuple[Tensor, ...]
    option: int = 0
    controls: Tensor | None = None
    constants: Array = np.empty(0)
    kept: int = 0
    by_step: int = 1
    shared: int = 0


class View(NamedTuple):
    """Where a tensor [N, T, K, C] is: its address (0 for none), whether it is float32, and its strides in bytes."""

    address: int
    single: int
    n: int
    t: int
    k: int
    c: int


NO_VIEW = View(0, 0, 0, 0, 0, 0)


def view_of(tensor: Tensor | None) -> View:
    """The view of a float32 or float64 tensor [N, T], [N, T, K] or [N, T, K, C]."""
    if tensor is None:
        return NO_VIEW
    each = tensor.element_size()
    n, t, k, c = (*tensor.stride(), 0, 0)[:4]
    return View(tensor.data_ptr(), int(each == 4), n * each, t * each, k * each, c * each)


class Task(NamedTuple):
    """A pass as compiled code reads it, from a row of whole numbers.

    :param group: the group of rows: 0 for selections, 1 for terminations, 2 for controls.
    :param first: its first column there.
    :param constants: index of its first constant; ``kept`` and ``shared`` likewise.
    :param raw: the first tensor; ``std`` is a σ of each step.
    :param of_raw: where its gradient goes; ``of_std`` likewise, ``posterior`` for the posteriors of the columns.
    """

    kind: int
    group: int
    first: int
    callers: int
    size: int
    option: int
    constants: int
    kept: int
    shared: int
    raw: View
    controls: View
    std: View
    of_raw: View
    of_std: View
    posterior: View


class Lot(NamedTuple):
    """Four trajectories side by side, and a block of their steps.

    Lengths ascend, and the last one is that of the lot. A lane without a trajectory has length 0.

    :param trajectories: address of their numbers; ``lengths`` likewise.
    :param begin: the first step of the block; ``end`` is the step after the last one.
    :param own: the lengths as lanes.
    """

    trajectories: int
    lengths: int
    begin: int
    end: int
    own: Any


class Rows(NamedTuple):
    """What the passes give of every step, or posteriors: tables of all levels side by side.

    :param selection: selection probabilities, Σ callers·C_d columns.
    :param termination: termination probabilities, Σ 2·k_d columns.
    :param control: densities of the controls, scaled at each step, 1 + Σ k_d columns.
    :param choice: factors of the joint choices, S columns; among posteriors, the marginals of the choices, Σ C_d
        columns. It has no columns where there are none.
    """

    selection: Plane
    termination: Plane
    control: Plane
    choice: Plane


class Room(NamedTuple):
    """Arrays of a block [block, n, lanes], used by one pass after the other."""

    raw: Plane
    controls: Plane
    std: Plane
    of_raw: Plane
    of_std: Plane


def task(address: int, index: int) -> Any:
    """A task of those at an address."""


record(task, Task)


@jit
def _address(view: View, lot: Lot, t: int, lane: int) -> int:
    """The address of a step; that of the last lane where this lane's trajectory is over."""
    own = lane if t < whole(lot.lengths, lane) else LAST
    return view.address + whole(lot.trajectories, own) * view.n + t * view.t  # type: ignore[no-any-return]


@jit
def _dense(view: View, callers: int, size: int) -> bool:
    """Whether at least four numbers of a step stand side by side."""
    each = 4 if view.single != 0 else 8
    rows = view.k == each * size and (size == 1 or view.c == each)
    return callers * size >= LANES and (rows or (callers == 1 and view.c == each))


@jit
def take(view: View, lot: Lot, callers: int, size: int, out: Plane) -> None:
    """Fill ``out`` [block, callers · size] from a tensor."""
    apart()
    single, many, each = view.single != 0, callers * size, 4 if view.single != 0 else 8
    dense = _dense(view, callers, size)
    for t in range(lot.begin, lot.end):
        i = t - lot.begin
        a, b = _address(view, lot, t, 0), _address(view, lot, t, 1)
        c, d = _address(view, lot, t, 2), _address(view, lot, t, 3)
        if dense:
            for j in range(0, many, LANES):
                first = min(j, many - LANES)
                x = first * each
                gather_square(a + x, b + x, c + x, d + x, single, out, i, first)
        else:
            for k in range(callers):
                for j in range(size):
                    x = k * view.k + j * view.c
                    put(out, i, k * size + j, gather(a + x, b + x, c + x, d + x, single))


@jit
def give(view: View, lot: Lot, callers: int, size: int, rows: Plane) -> None:
    """Write ``rows`` [block, callers · size] to a tensor. The last lane is written last, so it stays."""
    apart()
    single, many, each = view.single != 0, callers * size, 4 if view.single != 0 else 8
    dense = _dense(view, callers, size)
    for t in range(lot.begin, lot.end):
        i = t - lot.begin
        a, b = _address(view, lot, t, 0), _address(view, lot, t, 1)
        c, d = _address(view, lot, t, 2), _address(view, lot, t, 3)
        if dense:
            for j in range(0, many, LANES):
                first = min(j, many - LANES)
                x = first * each
                scatter_square(a + x, b + x, c + x, d + x, single, rows, i, first)
        else:
            for k in range(callers):
                for j in range(size):
                    x = k * view.k + j * view.c
                    scatter(a + x, b + x, c + x, d + x, single, at(rows, i, k * size + j))


# --- one pass after the other -----------------------------------------------------------------------------------------


@jit
def fill(of: Task, lot: Lot, constants: int, kept: Plane, rows: Rows, room: Room) -> None:
    """Fill the columns of a pass in ``rows`` with probabilities, or add log-densities to them."""
    apart()
    take(of.raw, lot, of.callers, of.size, room.raw)
    if of.kind >= NORMAL:
        _take_controls(of, lot, room)
    if of.kind == PROBABILITIES:
        _exponentials(of, lot, room.raw, rows.selection if of.group == 0 else rows.termination)
    elif of.kind == LOGARITHMS:
        for t in range(lot.end - lot.begin):
            for j in range(of.callers * of.size):
                density = at(rows.control, lot.begin + t, of.first + j) + at(room.raw, t, j)
                put(rows.control, lot.begin + t, of.first + j, density)
    elif of.kind == SOFTMAX:
        _softmax(of, lot, room.raw, rows.selection)
    elif of.kind == TERMINATIONS:
        _terminations(of, lot, room.raw, kept, rows.termination)
    elif of.kind == NORMAL:
        _normal(of, lot, constants, kept, rows.control, room)
    elif of.kind == SWITCHES:
        _switches(of, lot, kept, rows.control, room)
    else:
        _categories(of, lot, kept, rows.control, room)


@jit
def slope(
    of: Task, lot: Lot, constants: int, kept: Plane, rows: Rows, posterior: Rows, shared: Plane, room: Room
) -> None:
    """Write the posteriors of a pass and the gradients of its tensors; add to those that steps share.

    :param posterior: of the block.
    :param shared: [1, n, lanes].
    """
    apart()
    found = posterior.selection if of.group == 0 else (posterior.termination if of.group == 1 else posterior.control)
    columns = of.callers * of.size
    if of.kind == SOFTMAX:
        columns = of.callers * (of.option + of.size)
    elif of.kind == TERMINATIONS:
        columns = 2 * of.callers
    elif of.kind >= NORMAL:
        columns = of.callers
    if of.posterior.address != 0:
        for t in range(lot.end - lot.begin):
            for j in range(columns):
                put(room.of_raw, t, j, at(found, t, of.first + j))
        give(of.posterior, lot, columns, np.intp(1), room.of_raw)
    if of.of_raw.address == 0:
        return
    if of.kind <= LOGARITHMS:
        for t in range(lot.end - lot.begin):
            for j in range(columns):
                put(room.of_raw, t, j, at(found, t, of.first + j))
    elif of.kind == SOFTMAX:
        _softmax_slope(of, lot, rows.selection, found, room.of_raw)
    elif of.kind == TERMINATIONS:
        _terminations_slope(of, lot, kept, rows.termination, found, room.of_raw)
    elif of.kind == NORMAL:
        take(of.raw, lot, of.callers, of.size, room.raw)
        _take_controls(of, lot, room)
        _normal_slope(of, lot, constants, kept, found, shared, room)
    else:
        if of.kind == CATEGORIES:
            _take_controls(of, lot, room)
        for t in range(lot.end - lot.begin):
            for k in range(of.callers):
                share = at(found, t, of.first + k)
                for i in range(of.size):
                    change = at(kept, lot.begin + t, of.kept + k * of.size + i)
                    if of.kind == CATEGORIES:
                        change = where(at(room.controls, t, 0) == float(i), 1.0 - change, 0.0 - change)
                    put(room.of_raw, t, k * of.size + i, share * change)
    give(of.of_raw, lot, of.callers, of.size, room.of_raw)
    if of.of_std.address != 0:
        give(of.of_std, lot, of.callers, of.size, room.of_std)


@jit
def _exponentials(of: Task, lot: Lot, logs: Plane, rows: Plane) -> None:
    apart()
    for t in range(lot.end - lot.begin):
        for j in range(of.callers * of.size):
            put(rows, lot.begin + t, of.first + j, exponential(at(logs, t, j)))


@jit
def _softmax(of: Task, lot: Lot, logits: Plane, rows: Plane) -> None:
    apart()
    for t in range(lot.end - lot.begin):
        for k in range(of.callers):
            own, column = k * of.size, of.first + k * (of.option + of.size)
            for j in range(of.option):
                put(rows, lot.begin + t, column + j, 0.0)
            column += of.option
            top, total = at(logits, t, own), lanes(0.0)
            for j in range(1, of.size):
                x = at(logits, t, own + j)
                top = where(top < x, x, top)
            for j in range(of.size):
                share = exponential(at(logits, t, own + j) - top)
                total = total + share
                put(rows, lot.begin + t, column + j, share)
            total = 1.0 / total
            for j in range(of.size):
                put(rows, lot.begin + t, column + j, at(rows, lot.begin + t, column + j) * total)


@jit
def _softmax_slope(of: Task, lot: Lot, rows: Plane, found: Plane, out: Plane) -> None:
    apart()
    for t in range(lot.end - lot.begin):
        for k in range(of.callers):
            column, total = of.first + k * (of.option + of.size) + of.option, lanes(0.0)
            for j in range(of.size):
                total = total + at(found, t, column + j)
            for j in range(of.size):
                change = at(found, t, column + j) - at(rows, lot.begin + t, column + j) * total
                put(out, t, k * of.size + j, change)


@jit
def _terminations(of: Task, lot: Lot, logits: Plane, kept: Plane, rows: Plane) -> None:
    """1 - ψ and ψ; kept is the slope of the bound."""
    apart()
    for t in range(lot.end - lot.begin):
        for j in range(of.callers):
            x = at(logits, t, j) * (2.0 / TERMINATION_BOUND)
            bound = 1.0 - 2.0 / (1.0 + exponential(where(x > 700.0, 700.0, x)))
            other = exponential(bound * -TERMINATION_BOUND)
            ending = 1.0 / (1.0 + other)
            put(rows, lot.begin + t, of.first + 2 * j, other * ending)
            put(rows, lot.begin + t, of.first + 2 * j + 1, ending)
            put(kept, lot.begin + t, of.kept + j, 1.0 - bound * bound)


@jit
def _terminations_slope(of: Task, lot: Lot, kept: Plane, rows: Plane, found: Plane, out: Plane) -> None:
    """(q_1 (1 - ψ) - q_0 ψ) times the slope of the bound, for posteriors q."""
    apart()
    for t in range(lot.end - lot.begin):
        for j in range(of.callers):
            column = of.first + 2 * j
            up = at(found, t, column + 1) * at(rows, lot.begin + t, column)
            down = at(found, t, column) * at(rows, lot.begin + t, column + 1)
            put(out, t, j, (up - down) * at(kept, lot.begin + t, of.kept + j))


@jit
def _take_controls(of: Task, lot: Lot, room: Room) -> None:
    """Fill the controls of a block; after them, for a hurdle, 1 where all are 0."""
    apart()
    numbers = 1 if of.kind == CATEGORIES else of.size
    if of.kind == SWITCHES and of.option > 0:
        numbers = of.option
    take(of.controls, lot, numbers, np.intp(1), room.controls)
    if of.option > 0:
        for t in range(lot.end - lot.begin):
            rest = lanes(0.0) == 0.0
            for d in range(numbers):
                rest = rest & (at(room.controls, t, d) == 0.0)
            put(room.controls, t, numbers, where(rest, 1.0, 0.0))


@jit
def _normal(of: Task, lot: Lot, constants: int, kept: Plane, rows: Plane, room: Room) -> None:
    """Add log-densities within the bounds and log-masses on them; kept is φ / Φ of the masses.

    Constants are K·A times 1/σ, then as many times log σ with the constant of the normal, then both bounds of each
    dimension. Where σ depends on the step, the constants are without it.
    """
    apart()
    size, steps, many = of.size, lot.end - lot.begin, of.callers * of.size
    normalising, bounds = of.constants + many, of.constants + 2 * many
    if of.std.address != 0:
        take(of.std, lot, of.callers, size, room.std)
    for i in range(many):
        d, column = i % size, of.first + i // size
        low, high = number(constants, bounds + d), number(constants, bounds + size + d)
        bounded = low > -np.inf or high < np.inf
        for t in range(steps):
            control = at(room.controls, t, d)
            inverse, constant = lanes(number(constants, of.constants + i)), lanes(number(constants, normalising + i))
            if of.std.address != 0:
                std = at(room.std, t, i)
                inverse, constant = 1.0 / std, constant + logarithm(std)
            z = (control - at(room.raw, t, i)) * inverse
            density = z * z * -0.5 - constant
            below, above = control <= low, high <= control
            if bounded and any_of(below | above):
                x = (where(below, low, high) - at(room.raw, t, i)) * inverse
                mass, ratio = log_normal_cdf(where(below, x, 0.0 - x))
                density = where(below | above, mass, density)
                put(kept, lot.begin + t, of.kept + i, ratio)
            if of.option > 0:
                density = where(at(room.controls, t, size) == 0.0, density, 0.0)
            put(rows, lot.begin + t, column, at(rows, lot.begin + t, column) + density)


@jit
def _normal_slope(of: Task, lot: Lot, constants: int, kept: Plane, found: Plane, shared: Plane, room: Room) -> None:
    """The gradients of μ and of a σ of each step; those of a shared σ, the units and the bounds are added up."""
    apart()
    size, steps, many = of.size, lot.end - lot.begin, of.callers * of.size
    bounds = of.constants + 2 * many
    if of.std.address != 0:
        take(of.std, lot, of.callers, size, room.std)
    for i in range(many):
        d, column = i % size, of.first + i // size
        low, high = number(constants, bounds + d), number(constants, bounds + size + d)
        bounded = low > -np.inf or high < np.inf
        of_std, of_scale, of_low, of_high = lanes(0.0), lanes(0.0), lanes(0.0), lanes(0.0)
        for t in range(steps):
            control, share, inverse = (
                at(room.controls, t, d),
                at(found, t, column),
                lanes(number(constants, of.constants + i)),
            )
            if of.option > 0:
                share = where(at(room.controls, t, size) == 0.0, share, 0.0)
            if of.std.address != 0:
                inverse = 1.0 / at(room.std, t, i)
            mean = at(room.raw, t, i)
            z, over = (control - mean) * inverse, share * inverse
            change, of_own, inside = z * over, (z * z - 1.0) * over, share
            below, above = control <= low, high <= control
            if bounded and any_of(below | above):
                x, mass = (where(below, low, high) - mean) * inverse, over * at(kept, lot.begin + t, of.kept + i)
                on = below | above
                signed = where(below, mass, 0.0 - mass)
                change, of_own = where(on, 0.0 - signed, change), where(on, 0.0 - signed * x, of_own)
                of_low, of_high = of_low + where(below, mass, 0.0), of_high - where(above, mass, 0.0)
                inside = where(on, 0.0, share)
            put(room.of_raw, t, i, change)
            if of.of_std.address != 0:
                put(room.of_std, t, i, of_own)
            of_std, of_scale = of_std + of_own, of_scale - inside
        s = of.shared + i
        put(shared, 0, s, at(shared, 0, s) + of_std)
        put(shared, 0, s + many, at(shared, 0, s + many) + of_scale)
        put(shared, 0, s + 2 * many, at(shared, 0, s + 2 * many) + of_low)
        put(shared, 0, s + 3 * many, at(shared, 0, s + 3 * many) + of_high)


@jit
def _switches(of: Task, lot: Lot, kept: Plane, rows: Plane, room: Room) -> None:
    """Add log logistic(±y); kept is its derivative in y. A hurdle's switch is on where all controls are 0."""
    apart()
    for t in range(lot.end - lot.begin):
        for k in range(of.callers):
            density = lanes(0.0)
            for d in range(of.size):
                position, y = at(room.controls, t, of.option + d), at(room.raw, t, k * of.size + d)
                on = position == 1.0
                x = where(on, y, 0.0 - y)
                other = exponential(0.0 - absolute(x))
                short = where(x < 0.0, x, 0.0) - logarithm(other + 1.0)
                change = where(x < 0.0, 1.0, other) / (other + 1.0)
                possible = on | (position == 0.0)
                density = density + where(possible, short, -np.inf)
                change = where(possible, where(on, change, 0.0 - change), 0.0)
                put(kept, lot.begin + t, of.kept + k * of.size + d, change)
            put(rows, lot.begin + t, of.first + k, at(rows, lot.begin + t, of.first + k) + density)


@jit
def _categories(of: Task, lot: Lot, kept: Plane, rows: Plane, room: Room) -> None:
    """Add the log-softmax of the action; kept are the probabilities. An action below 0 is impossible."""
    apart()
    for t in range(lot.end - lot.begin):
        action = at(room.controls, t, 0)
        for k in range(of.callers):
            own, column = k * of.size, of.kept + k * of.size
            top, total, chosen = at(room.raw, t, own), lanes(0.0), lanes(-np.inf)
            for j in range(1, of.size):
                x = at(room.raw, t, own + j)
                top = where(top < x, x, top)
            for j in range(of.size):
                x = at(room.raw, t, own + j) - top
                share = exponential(x)
                total, chosen = total + share, where(action == float(j), x, chosen)
                put(kept, lot.begin + t, column + j, share)
            density = chosen - logarithm(total)
            for j in range(of.size):
                put(kept, lot.begin + t, column + j, at(kept, lot.begin + t, column + j) / total)
            put(rows, lot.begin + t, of.first + k, at(rows, lot.begin + t, of.first + k) + density)
