"""What the public functions of inference accept: tables that go together, and the length of each trajectory.

The compiled engines index without bounds, so a wrong length or shape would read and write memory that is not theirs.
:func:`checked` asks once, where a caller enters; the library's own training and evaluation call the functions within.
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
    """Tables or lengths that are no trajectories of an AHMM, or trajectories that have no posterior."""


Function = TypeVar("Function", bound=Callable[..., Any])


def checked(function: Function) -> Function:
    """The same function of tables and lengths, which refuses what :func:`check_lengths` or :func:`check_tables` do."""

    @wraps(function)
    def guarded(tables: Tables, lengths: Tensor, *others: Any, **named: Any) -> Any:
        steps = check_lengths(lengths, *check_tables(tables))
        _check_values(tables, steps)
        return function(tables, steps, *others, **named)

    return cast(Function, guarded)


def check_lengths(lengths: Tensor, number: int, steps: int) -> Tensor:
    """The lengths of ``number`` trajectories as int64, each from 1 to ``steps``.

    :raises BadTables: the lengths are no integer tensor [N], or one is out of range.
    """
    if not isinstance(lengths, Tensor) or lengths.is_floating_point() or lengths.dtype == torch.bool:
        raise BadTables(f"lengths: give a tensor of integers, one for each trajectory; got {_described(lengths)}")
    if lengths.shape != (number,):
        raise BadTables(f"lengths: there are {number} trajectories; got {_described(lengths)}")
    for n, length in enumerate(lengths.tolist()):
        if not 1 <= length <= steps:
            raise BadTables(f"lengths: trajectory {n} has {length} steps; the tables hold 1 to {steps}")
    return lengths.long()


def check_tables(tables: Tables) -> tuple[int, int]:
    """N and T of tables whose shapes are those that :class:`ddco_pyro.model.tables.Tables` documents.

    :raises BadTables: a table is missing or has another shape, or is not of floating-point numbers.
    """
    depth = tables.depth
    numbers = {"termination": depth, "control": depth + 1, "evidence": depth if tables.evidence else 0}
    for name, needed in numbers.items():
        if (got := len(getattr(tables, name))) != needed:
            raise BadTables(f"{name}: tables with {depth} levels of selections need {needed}; got {got}")
    for level, table in enumerate(tables.selection):
        if table.dim() != 4 or table.shape[-1] < 2:
            raise BadTables(f"selection[{level}]: expected [N, T, callers, 1 + options]; got {_described(table)}")
    first = tables.control[-1]
    if first.dim() != 3 or not len(first):
        raise BadTables(f"control[{depth}]: expected the shape [N, T, 1] with N at least 1; got {_described(first)}")
    number, steps = first.shape[:2]
    for (name, given), shape in zip(_named(tables), _shapes(tables), strict=True):
        if given is not None and (not given.is_floating_point() or given.shape != (number, steps, *shape)):
            expected = [number, steps, *shape]
            raise BadTables(f"{name}: expected floating-point numbers {expected}; got {_described(given)}")
    return number, steps


def _shapes(tables: Tables) -> Iterator[tuple[int, ...]]:
    """The shape of each table at one step, in the order of :meth:`Tables.leaves`: counts follow from selections."""
    choices = [table.shape[-1] for table in tables.selection]
    callers = [*(size - 1 for size in choices[1:]), 1][: len(choices)]
    yield from zip(callers, choices, strict=True)
    yield from ((size - 1, 2) for size in choices)
    yield from ((size - 1,) for size in choices)
    yield (1,)
    yield from ((size,) for size in choices[: len(tables.evidence)])


def _check_values(tables: Tables, lengths: Tensor) -> None:
    """Within the lengths a logarithm is a number below +inf; -inf is what cannot happen."""
    alive = torch.arange(tables.steps, device=lengths.device) < lengths[:, None]
    for name, table in _named(tables):
        if table is None:
            continue
        bad = ~(table.detach() < torch.inf).flatten(2).all(-1) & alive  # NaN is not below either
        if bool(bad.any()):
            n, t = torch.nonzero(bad)[0].tolist()
            raise BadTables(f"{name}: a log-probability of trajectory {n} at step {t} is NaN or +inf")


def refuse_impossible(possible: Tensor) -> None:
    """Refuse a posterior of trajectories of which no path is ``possible`` [N]; their log-likelihood is -inf.

    :raises BadTables: there is such a trajectory.
    """
    for n in torch.nonzero(~possible).flatten().tolist():
        raise BadTables(f"trajectory {n} has probability 0 whatever its options, so there is no posterior of its path")


def _named(tables: Tables) -> Iterator[tuple[str, Tensor | None]]:
    for name in ("selection", "termination", "control", "evidence"):
        for level, table in enumerate(getattr(tables, name)):
            yield f"{name}[{level}]", table


def _described(given: Any) -> str:
    if not isinstance(given, Tensor):
        return type(given).__name__
    return f"{str(given.dtype).removeprefix('torch.')} {list(given.shape)}"
