"""Phases of a toy expert, whose methods are traced while it acts."""

from __future__ import annotations

import functools

import pytest
from arena_phases import Phases


def twice(function):
    @functools.wraps(function)
    def wrapped(*arguments):
        return list(function(*arguments))

    return wrapped


class Expert:
    """Which of its four return statements was reached is known from the value alone."""

    @staticmethod
    def _desired_pos(x):
        def shifted(y):
            return y + 100  # not a return of the outer function

        if x < 0:
            place = [shifted(0), 0]
            return place
        elif x < 1:
            return [
                1,
                x,
            ]
        for number in (2, 3):
            if x < number:
                return [number, x]
        return [4, x]

    def get_action(self, x):
        self._desired_pos(-1)  # the last call counts
        return self._desired_pos(x)


PLACES = {-0.5: 0, 0.5: 1, 1.5: 2, 2.5: 2, 7.0: 3}


@pytest.mark.parametrize(("x", "phase"), PLACES.items())
def test_a_phase_is_the_return_statement_that_was_reached(x, phase):
    phases, expert = Phases(Expert._desired_pos), Expert()
    assert len(phases.lines) == 4
    assert phases.lines == sorted(phases.lines)
    value, reached = phases.of(expert.get_action, x)
    assert (value, reached) == (expert.get_action(x), phase)


def test_a_decorated_function_is_seen_through():
    @twice
    def desired(x):
        if x:
            return [1]
        return [0]

    phases = Phases(desired)
    assert [phases.of(desired, x) for x in (True, False)] == [([1], 0), ([0], 1)]
