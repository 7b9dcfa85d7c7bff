"""Expected wrong steps against planted ones, and the order against what a person can see in a planted set."""

import numpy as np
import pytest

from ddco_pyro.labelling.proposals import Shown, excess, expected_wrong, ranking, unforeseen


def proposed(generator, steps, sure):
    """Proposals and true options. A share ``sure`` of steps is wrong; others are right with probability p."""
    truth, p = generator.integers(1, 4, steps), generator.beta(8, 1, steps)
    wrong = (generator.random(steps) > p) | (generator.random(steps) < sure)
    return Shown(np.where(wrong, truth % 3 + 1, truth), p), truth


@pytest.mark.parametrize("sure", [0.0, 0.05, 0.3])
def test_expected_wrong_steps_are_the_planted_ones_whatever_the_posterior_misses(sure):
    generator = np.random.default_rng(0)
    known = [excess(*proposed(generator, 2000, sure)) for _ in range(6)]
    found = unforeseen(known[:1], known[1:])
    shown, truth = proposed(generator, 20_000, sure)
    free = np.full(20_000, -1)
    assert expected_wrong(shown, free, found) == pytest.approx((shown.options != truth).sum(), rel=0.1)
    half = np.where(np.arange(20_000) < 10_000, truth, -1)
    half[15_000:] = -2  # what is left open is none's fault
    quarter = expected_wrong(shown, free, found) / 4
    assert expected_wrong(shown, half, found) == pytest.approx(quarter, rel=0.1)


def test_steps_without_a_name_say_nothing_of_a_proposal():
    shown = Shown(np.array([1, 2, 2, 3]), np.array([0.9, 0.8, 0.7, 0.6]))
    assert excess(shown, np.array([1, 1, -1, -2])) == pytest.approx(1 / 2 - (0.1 + 0.2) / 2)
    assert excess(shown, np.full(4, -1)) == 0.0


def order_of(wrong, edits, centres, accepted=()):
    count = len(wrong)
    given = (np.array(values, float) for values in (wrong, edits, centres))
    return ranking(*given, np.isin(np.arange(count), accepted))


def test_a_long_odd_demonstration_comes_after_usual_ones_with_fewer_wrong_steps():
    wrong, edits = [10, 11, 12, 40], [2, 2, 2, 12]
    centres = [[0.0], [0.1], [0.2], [3.0]]
    assert order_of(wrong, edits, centres)[0] == [2, 1, 0, 3]
    # equally odd and costly: the most wrong steps
    assert order_of(wrong, [2] * 4, [[0.0]] * 4)[0] == [3, 2, 1, 0]
    assert order_of([10] * 4, edits, [[0.0]] * 4)[0][-1] == 3  # costly alone
    assert order_of([10] * 4, [2] * 4, centres)[0][-1] == 3  # odd alone


def test_the_next_one_is_of_another_kind_than_accepted_ones_which_come_last():
    centres = [[0.0], [0.1], [0.2], [5.0], [5.1], [5.2]]
    ranked, farthest = order_of([10] * 6, [2] * 6, centres, accepted=(1,))
    assert ranked[0] in (3, 4, 5)
    assert ranked[-1] == 1
    assert farthest == 5
    assert order_of([10] * 6, [2] * 6, centres)[1] is None
