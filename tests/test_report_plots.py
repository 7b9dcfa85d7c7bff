"""What the figures of the report are drawn from, beside cases worked by hand."""

import numpy as np
import pytest
from moving_demonstrations import reaches, recorded

from ddco_pyro.drawing.shown import movement, position_key
from ddco_pyro.report.activity import Activity, LevelActivity, bins
from ddco_pyro.report.options import row_order, shares, terminations


def test_bins_are_steps_where_demonstrations_are_equally_long():
    found = bins(np.array([4, 4]))
    np.testing.assert_array_equal(found.index, [[0, 1, 2, 3]] * 2)
    np.testing.assert_array_equal(found.edges, [-0.5, 0.5, 1.5, 2.5, 3.5])


def test_bins_are_normalised_time_otherwise():
    found = bins(np.array([2, 4]))
    np.testing.assert_array_equal(found.index, [[0, 1, -1, -1], [0, 0, 1, 1]])
    assert len(bins(np.array([2000, 1999])).edges) == 61


def test_shares_and_terminations_are_weighted_means():
    active = np.array([[[0, 1, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]], dtype=float)
    termination = np.array([[[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]], [[0.1, 0.2], [0.7, 0.8], [0.9, 1.0]]])
    level = LevelActivity("option", active, np.zeros((2, 3), int), np.zeros((2, 3), int), termination)
    gathered = bins(np.array([3, 3]))
    np.testing.assert_allclose(shares(level, gathered), [[0, 1, 0], [0, 0.75, 0.25], [0, 0, 1]])
    nan = np.nan  # no option ends before the first step, and option 2 is not active before the last
    expected = [[nan, nan], [0.5, nan], [(0.5 + 0.5 * 0.9) / 1.5, 1.0]]
    np.testing.assert_allclose(terminations(level, gathered), expected)


def test_rows_are_sorted_by_length_then_by_the_first_change():
    """Two levels, of which the lowest counts; a demonstration without a change comes after those of its length."""
    paths = ["11222", "1222-", "12111", "1111-", "11111", "1121-", "1----"]
    low = np.array([[-1 if step == "-" else int(step) for step in path] for path in paths])
    high = np.array([[1, 2, 1, 1, 1]] * len(paths))
    nothing = np.zeros((len(paths), 5, 3))
    levels = tuple(
        LevelActivity(name, nothing, path, np.zeros_like(path), nothing)
        for name, path in (("low", low), ("high", high))
    )
    found = row_order(Activity(levels, (low >= 0).sum(1)))
    assert [paths[row] for row in found] == ["1----", "1222-", "1121-", "1111-", "12111", "11222", "11111"]


def test_what_moves_is_drawn_whatever_comes_first():
    """Before it in the alphabet: what is constant within each demonstration, in all of them, or only measured badly."""
    rng, hands = np.random.default_rng(1), reaches()
    steps = [np.ones((len(hand), 1)) for hand in hands]
    demos = recorded(
        base=[step * np.array([0.1, 0.2, 0.3]) for step in steps],
        goal=[step * rng.normal(size=3) for step in steps],
        guess=[step * rng.normal(size=3) + 1e-3 * rng.normal(size=(len(step), 3)) for step in steps],
        hand=hands,
    )
    assert position_key(demos) == "hand"


def test_nothing_is_drawn_where_nothing_moves():
    assert position_key(recorded(goal=[np.full((5, 3), 0.1), np.full((1, 3), 0.7)])) is None


def test_movement_by_hand():
    """Even steps along a straight line: 1; there and back: half as far for the way it goes."""
    line = np.arange(5.0)[:, None] * np.array([1.0, 2.0, 2.0])
    assert movement([line, line]) == pytest.approx(1)
    assert movement([line[[0, 1, 2, 1, 0]]] * 2) == pytest.approx(0.5)
    assert movement([np.hstack([line, line])] * 2) == pytest.approx(0.5)
    within, between = 9 * 2.0, 3 * 4.0  # the variance of 0 to 4 is 2; that of a mean of -2 and one of 2 is 4
    assert movement([line - 2, line + 2]) == pytest.approx(np.sqrt(within / (within + between)))
    assert movement([np.array([[1.0, 2.0, 3.0]])]) == 0
