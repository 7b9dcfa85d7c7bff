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


def short(option, selections, duration=1.0):
    return Finding("never_persisting", 1, option, duration, selections=selections)


def lasting(duration):
    return [level(0.0, 0.5, 0.5, durations=[None, duration, 5.0])]


@pytest.mark.parametrize(
    ("levels", "found"),
    [
        ([], []),
        ([level(0.0, 0.3, 0.3, 0.4)], []),
        ([level(0.0, 0.0099, 0.5, 0.4901)], [Finding("unused", 1, 1, 0.0099)]),
        ([level(0.0, 0.01, 0.5, 0.49)], []),
        ([level(0.0, 0.1, 0.9)], []),
        ([level(0.0, 0.099, 0.901)], [Finding("dominating", 1, 2, 0.901)]),
        ([level(0.0, 1.0)], []),  # a single option cannot dominate
        (lasting(1.49), [short(1, 10.0, 1.49)]),
        (lasting(1.5), []),
        (lasting(None), []),
        ([level(0.5, 0.25, 0.25, durations=[1.0, 5.0, 5.0])], []),
        ([level(0.51, 0.245, 0.245, durations=[1.0, 5.0, 5.0])], [Finding("high_fitting", 1, 0, 0.51)]),
        # an unused option is not also said to be short
        ([level(0.0, 0.001, 0.4995, 0.4995, durations=[None, 1.0, 5.0, 5.0])], [Finding("unused", 1, 1, 0.001)]),
        # the meta-policy does all the work of option 1, which ends at once and is selected again; option 2 lasts
        (use(*[[(1, 1)] * 6 + [(2, 6)]] * 4), [short(1, 6.0)]),
        # two options take turns at every step
        (use(*[[(1, 1), (2, 1)] * 4] * 3), [short(1, 4.0), short(2, 4.0)]),
        # the first reach of every demonstration, and a grasp: each is selected once and ends by design
        (use(*[[(1, 1), (2, 6), (3, 1), (2, 7)]] * 4), []),
        # one demonstration in ten flickers; that it is not in the others is no excuse
        (use([(1, 1)] * 10, *[[(2, 5), (3, 5)]] * 9), [short(1, 10.0)]),
    ],
)
def test_signs_of_a_degenerate_solution(levels, found):
    assert diagnose(levels) == found


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


def test_control_by_a_caller_above_does_not_count_for_the_one_below():
    upper = level(0.6, 0.2, 0.2)
    lower = level(0.7, 0.15, 0.15)  # the upper options emit control in 0.1 of the 0.4 in which they act
    assert [(one.kind, one.level) for one in diagnose([lower, upper])] == [("high_fitting", 2)]
