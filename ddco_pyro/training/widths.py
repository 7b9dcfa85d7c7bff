"""Widths of hidden layers that give a model a number of parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence


def nearest_widths(hidden: Sequence[int], target: int, parameters: Callable[[tuple[int, ...]], int]) -> tuple[int, ...]:
    """Hidden layers, all of them scaled by one factor, whose number of ``parameters`` is nearest to ``target``; the
    narrower ones where two are equally near.
    """
    widest = max(hidden)

    def scaled(width: int) -> tuple[int, ...]:
        return tuple(max(1, round(size * width / widest)) for size in hidden)

    low, high = 1, 2  # the first width that has enough parameters lies above low and at or below high
    while parameters(scaled(high)) < target:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if parameters(scaled(middle)) < target else (low, middle)
    return min(scaled(low), scaled(high), key=lambda sizes: abs(parameters(sizes) - target))
