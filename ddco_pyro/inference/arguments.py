"""Checks of the arguments of public inference functions: tables of fitting shapes, and the length of each
trajectory.

The compiled engines index without bounds checks, so a wrong length or shape would read and write foreign
memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from ddco_pyro.errors import BadInput
from ddco_pyro.model.tables import Tables


class BadTables(BadInput):
    """Tables or lengths that do not describe trajectories of an AHMM, or trajectories without a posterior."""


Function = TypeVar("Function", bound=Callable[..., Any])


def checked(function: Function) -> Function:
    """The same function of tables and lengths, with its arguments checked."""

    @wraps(function)
    def guarded(tables: Tables, lengths: Tensor, *others: Any, **named: Any) -> Any:
        return function(tables, check(tables, lengths), *others, **named)

    return cast(Function, guarded)


def check(tables: Tables, lengths: Tensor) -> Tensor:
    """The lengths as int64, once tables have the shapes of :class:`ddco_pyro.model.tables.Tables` and fit the
    lengths.

    :raises BadTables: a table is missing, has another shape or is not floating-point; a length is out of
        range; or a log-probability within the lengths is NaN or +inf.
    """
    number, steps = _sizes(tables)
    lengths = check_lengths(lengths, number, steps)
    alive = torch.arange(steps, device=lengths.device) < lengths[:, None]
    for name, table, shape in _expected(tables):
        expected = [number, steps, *shape]
        if not table.is_floating_point() or list(table.shape) != expected:
            raise BadTables(f"{name}: expected floating-point numbers {expected}; got {_described(table)}")
        bad = ~(table.detach() < torch.inf).flatten(2).all(-1) & alive  # NaN is not below either
        if bool(bad.any()):
            n, t = torch.nonzero(bad)[0].tolist()
            raise BadTables(f"{name}: a log-probability of trajectory {n} at step {t} is NaN or +inf")
    return lengths


def check_lengths(lengths: Tensor, number: int, steps: int) -> Tensor:
    """The lengths of ``number`` trajectories as int64, each from 1 to ``steps``.

    :raises BadTables: the lengths are no integer tensor [N], or one is out of range.
    """
    if not isinstance(lengths, Tensor) or lengths.is_floating_point() or lengths.dtype == torch.bool:
        raise BadTables(
            f"lengths: give a tensor of integers, one for each trajectory; got {_described(lengths)}"
        )
    if lengths.shape != (number,):
        raise BadTables(f"lengths: there are {number} trajectories; got {_described(lengths)}")
    for n, length in enumerate(lengths.tolist()):
        if not 1 <= length <= steps:
            raise BadTables(f"lengths: trajectory {n} has {length} steps; the tables hold 1 to {steps}")
    return lengths.long()


def refuse_impossible(possible: Tensor) -> None:
    """Raise for a trajectory that is not ``possible`` [N].

    :raises BadTables: there is such a trajectory.
    """
    for n in torch.nonzero(~possible).flatten().tolist():
        raise BadTables(
            f"trajectory {n} has probability 0 whatever its options, so there is no posterior of its path"
        )


def _sizes(tables: Tables) -> tuple[int, int]:
    """N and T, once there are tables of every level that say how many choices it has.

    :raises BadTables: a table is missing, or has another number of dimensions.
    """
    depth = tables.depth
    numbers = {"termination": depth, "control": depth + 1, "evidence": depth if tables.evidence else 0}
    for name, needed in numbers.items():
        if (got := len(getattr(tables, name))) != needed:
            raise BadTables(f"{name}: tables with {depth} levels of selections need {needed}; got {got}")
    for level, table in enumerate(tables.selection):
        if table.dim() != 4 or table.shape[-1] < 2:
            raise BadTables(
                f"selection[{level}]: expected [N, T, callers, 1 + options]; got {_described(table)}"
            )
    last = tables.control[-1]
    if last.dim() != 3 or not len(last):
        raise BadTables(
            f"control[{depth}]: expected the shape [N, T, 1] with N at least 1; got {_described(last)}"
        )
    return last.shape[0], last.shape[1]


def _expected(tables: Tables) -> Iterator[tuple[str, Tensor, tuple[int, ...]]]:
    """Each table with its name and its shape at one step; numbers of choices follow from the selections."""
    options = [table.shape[-1] - 1 for table in tables.selection]
    for level, (own, callers) in enumerate(zip(options, [*options[1:], 1], strict=False)):
        yield f"selection[{level}]", tables.selection[level], (callers, 1 + own)
        yield f"termination[{level}]", tables.termination[level], (own, 2)
        yield f"control[{level}]", tables.control[level], (own,)
        if tables.evidence and (evidence := tables.evidence[level]) is not None:
            yield f"evidence[{level}]", evidence, (1 + own,)
    yield f"control[{tables.depth}]", tables.control[-1], (1,)


def _described(given: Any) -> str:
    if not isinstance(given, Tensor):
        return type(given).__name__
    return f"{str(given.dtype).removeprefix('torch.')} {list(given.shape)}"
