"""Phases of a toy expert, whose methods are traced while it acts."""

from __future__ import annotations

import functools
import sys

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


def test_lines_are_those_of_the_file():
    with open(__file__) as file:
        text = file.read().splitlines()
    first, second, third, fourth = (text[line - 1].strip() for line in Phases(Expert._desired_pos).lines)
    assert (first, second, third, fourth) == ("return place", "return [", "return [number, x]", "return [4, x]")


def test_a_decorated_function_is_seen_through():
    @twice
    def desired(x):
        if x:
            return [1]
        return [0]

    phases = Phases(desired)
    assert [phases.of(desired, x) for x in (True, False)] == [([1], 0), ([0], 1)]


def test_tracing_is_left_as_it_was():
    def fails():
        raise KeyError

    def mine(*_):
        return None

    phases, before = Phases(Expert._desired_pos), sys.gettrace()
    try:
        sys.settrace(mine)
        phases.of(Expert._desired_pos, 0)
        assert sys.gettrace() is mine
        with pytest.raises(KeyError):
            phases.of(fails)
        assert sys.gettrace() is mine
    finally:
        sys.settrace(before)


def test_what_has_no_phase_is_refused():
    phases = Phases(Expert._desired_pos)
    phases.of(Expert._desired_pos, 0)
    with pytest.raises(LookupError, match="_desired_pos was not called"):
        phases.of(abs, -1)

    def nothing():
        pass

    with pytest.raises(ValueError, match="has no return statement"):
        Phases(nothing)
