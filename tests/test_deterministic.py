"""Tests do not fail because the machine is busy, and draw the same examples every time."""

from __future__ import annotations

import time

from hypothesis import given, settings
from hypothesis import strategies as st


@settings(max_examples=2)
@given(st.booleans())
def test_an_example_may_take_long(value: bool) -> None:
    time.sleep(0.25)  # hypothesis' own deadline is 0.2 s


def drawn() -> list[int]:
    """The examples of a test."""
    found: list[int] = []

    @given(st.integers())
    def draw(value: int) -> None:
        found.append(value)

    draw()
    return found


def test_examples_are_the_same_every_time() -> None:
    first = drawn()
    assert len(set(first)) > 10
    assert drawn() == first
