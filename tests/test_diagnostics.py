import pytest
import torch

from ddco_pyro.evaluation.options import Finding, diagnose, option_use
from ddco_pyro.inference import Posterior
from ddco_pyro.metrics import Alike, Use


def level(*shares, durations=None):
    """Options that are selected ten times in each of two demonstrations."""
    durations = durations or [5.0] * len(shares)
    return [
        Use(choice=choice, share=share, selected=20.0, demonstrations=2.0, duration=duration)
        for choice, (share, duration) in enumerate(zip(shares, durations, strict=True))
    ]


def use(*demonstrations):
    """The use of options under a posterior that is certain: of each demonstration, segments ``(option, steps)``."""
    size = 1 + max(option for segments in demonstrations for option, _ in segments)
    steps = max(sum(length for _, length in segments) for segments in demonstrations)
    active, selected = (torch.zeros(len(demonstrations), steps, size, dtype=torch.float64) for _ in range(2))
    for row, segments in enumerate(demonstrations):
        start = 0
        for option, length in segments:
            active[row, start : start + length, option] = 1
            selected[row, start, option] = 1
            start += length
    return option_use(Posterior((active,), (selected,), (active,)))


def test_a_balanced_solution_has_no_signs():
    assert diagnose([level(0.0, 0.3, 0.3, 0.4)]) == []
    assert diagnose([]) == []


@pytest.mark.parametrize(("share", "unused"), [(0.0099, True), (0.01, False)])
def test_unused_below_one_percent(share, unused):
    found = diagnose([level(0.0, share, 0.5, 0.5 - share)])
    assert found == ([Finding("unused", 1, 1, share)] if unused else [])


@pytest.mark.parametrize(("share", "dominating"), [(0.9, False), (0.901, True)])
def test_dominating_above_ninety_percent(share, dominating):
    found = diagnose([level(0.0, 1 - share, share)])
    assert found == ([Finding("dominating", 1, 2, share)] if dominating else [])


def test_a_single_option_cannot_dominate():
    assert diagnose([level(0.0, 1.0)]) == []


@pytest.mark.parametrize(("duration", "short"), [(1.49, True), (1.5, False), (None, False)])
def test_never_persisting_below_one_and_a_half_steps(duration, short):
    found = diagnose([level(0.0, 0.5, 0.5, durations=[None, duration, 5.0])])
    assert found == ([Finding("never_persisting", 1, 1, duration, selections=10.0)] if short else [])


def test_an_option_that_ends_at_once_and_is_selected_again_and_again_never_persists():
    """The meta-policy does all the work of option 1; option 2 lasts."""
    found = diagnose(use(*[[(1, 1)] * 6 + [(2, 6)]] * 4))
    assert found == [Finding("never_persisting", 1, 1, 1.0, selections=6.0)]


def test_options_that_take_turns_at_every_step_never_persist():
    found = diagnose(use(*[[(1, 1), (2, 1)] * 4] * 3))
    assert [(one.kind, one.choice) for one in found] == [("never_persisting", 1), ("never_persisting", 2)]


def test_an_option_that_lasts_one_step_once_is_no_sign():
    """The first reach of every demonstration, and a grasp: each is selected once and ends by design."""
    assert diagnose(use(*[[(1, 1), (2, 6), (3, 1), (2, 7)]] * 4)) == []


def test_selections_are_counted_where_an_option_is_used():
    """One demonstration in ten flickers; that it is not in the others is no excuse."""
    found = diagnose(use([(1, 1)] * 10, *[[(2, 5), (3, 5)]] * 9))
    assert found == [Finding("never_persisting", 1, 1, 1.0, selections=10.0)]


def test_an_unused_option_is_not_also_said_to_be_short():
    found = diagnose([level(0.0, 0.001, 0.999 / 2, 0.999 / 2, durations=[None, 1.0, 5.0, 5.0])])
    assert [one.kind for one in found] == ["unused"]


def pair(first, second, divergence):
    return Alike(options=(first, second), divergence=divergence)


@pytest.mark.parametrize(("divergence", "redundant"), [(0.0999, True), (0.1, False)])
def test_redundant_below_a_tenth_of_a_nat(divergence, redundant):
    alike = [pair(1, 2, 3.0), pair(1, 3, divergence), pair(2, 3, 4.0)]
    found = diagnose([level(0.0, 0.3, 0.3, 0.4)], [alike])
    assert found == ([Finding("redundant", 1, 3, divergence, other=1)] if redundant else [])


def test_an_unused_option_is_not_also_said_to_be_redundant():
    found = diagnose([level(0.0, 0.001, 0.5, 0.499)], [[pair(1, 2, 0.0), pair(1, 3, 0.0), pair(2, 3, 1.0)]])
    assert [one.kind for one in found] == ["unused"]


@pytest.mark.parametrize(("control", "high"), [(0.5, False), (0.51, True)])
def test_high_fitting_where_control_is_chosen_most_of_the_time(control, high):
    rest = (1 - control) / 2
    found = diagnose([level(control, rest, rest, durations=[1.0, 5.0, 5.0])])
    assert found == ([Finding("high_fitting", 1, 0, control)] if high else [])


def test_control_by_a_caller_above_does_not_count_for_the_one_below():
    upper = level(0.6, 0.2, 0.2)
    lower = level(0.7, 0.15, 0.15)  # the upper options emit control in 0.1 of the 0.4 in which they act
    assert [(one.kind, one.level) for one in diagnose([lower, upper])] == [("high_fitting", 2)]
