"""Rows of a benchmark: two things measured side by side, as in the tables of ``docs/performance.md``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

TURN = 0.02
"""Seconds of a turn in a pair."""


class Row(NamedTuple):
    """Two measurements and their ratio.

    :param ratio: of the first over the second.
    """

    first: str
    second: str
    value: float
    other: float
    ratio: float
    unit: str = "ms"


def seconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Time of one call by a clock."""
    start = clock()
    call()
    return clock() - start


def side_by_side(
    names: tuple[str, str],
    first: Callable[[], object],
    second: Callable[[], object],
    rounds: int = 21,
    clock: Callable[[], float] = time.process_time,
    warm: bool = True,
) -> Row:
    """The least times of both calls in turns, after each ran once if ``warm``, as the first may need.

    A turn repeats a short call for :data:`TURN` seconds. Others only add to times: minima are compared.
    """
    if warm:
        first()
    second()
    calls = [(call, max(1, int(TURN / seconds(call, clock))) if warm else 1) for call in (first, second)]

    def turn(call: Callable[[], object], times: int) -> float:
        return 1e3 / times * seconds(lambda: [call() for _ in range(times)], clock)

    value, other = map(min, zip(*((turn(*calls[0]), turn(*calls[1])) for _ in range(rounds)), strict=True))
    return Row(*names, value, other, value / other)


def of_pairs(names: tuple[str, str], pairs: Iterable[tuple[float, float]], unit: str = "ms") -> Row:
    """The row of measured pairs: medians, and the median of the pairs' ratios."""
    each = list(pairs)
    value, other = (statistics.median(column) for column in zip(*each, strict=True))
    return Row(*names, value, other, statistics.median(one / two for one, two in each), unit)


def table(rows: Iterable[Row], aims: dict[str, tuple[str, float]]) -> str:
    """Rows in Markdown.

    :param aims: the sign and the bound of a ratio, by ``first / second``.
    """
    lines = ["| first | | second | | first / second | aim |", "|---|---|---|---|---|---|"]
    for row in rows:
        aim = ""
        if bound := aims.get(f"{row.first} / {row.second}"):
            reached = row.ratio <= bound[1] if bound[0] == "≤" else row.ratio >= bound[1]
            aim = f"{bound[0]} {bound[1]:g} {'reached' if reached else '**not reached**'}"
        values = [f"{value:.3g} {row.unit}" for value in (row.value, row.other)]
        lines.append(f"| {row.first} | {values[0]} | {row.second} | {values[1]} | {row.ratio:.3g} | {aim} |")
    return "\n".join(lines) + "\n"
