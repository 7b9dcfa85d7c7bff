"""Statistics of studies against scipy's tests, hand-computed values, and planted truths."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from studies.declaration import ContrastSpec
from studies.statistics import COLUMNS, estimate, holm, values, verdicts

ROOT = Path(__file__).parents[2]


def by_seed(**tasks):
    """Values by task and training seed: of each task a list, or a mapping from seeds."""
    seeds = {task: own if isinstance(own, dict) else dict(enumerate(own)) for task, own in tasks.items()}
    return pd.Series({(task, str(seed)): float(x) for task, own in seeds.items() for seed, x in own.items()})


def paired(ours, theirs):
    """Differences between two methods of a table."""
    rows = [
        ("study", task, method, "5", seed, "nats", value)
        for method, own in (("ours", ours), ("theirs", theirs))
        for (task, seed), value in own.items()
    ]
    return values(pd.DataFrame(rows, columns=COLUMNS), "ours - theirs", "nats", [5], None)


def test_one_task_is_the_paired_t_test_over_seeds():
    random = np.random.default_rng(0)
    ours, theirs = random.normal(0.3, 1, 8), random.normal(0, 1, 8)
    found = estimate(paired(by_seed(push=ours), by_seed(push=theirs)))
    for bound in (0.0, 0.2, -0.1):
        test = stats.ttest_rel(ours, theirs + bound, alternative="greater")
        assert found.p_value(bound) == pytest.approx(test.pvalue)
    interval = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
    assert found.interval == pytest.approx((interval.low, interval.high))
    assert found.units == pytest.approx(tuple(ours - theirs))


def test_the_units_of_several_tasks_are_their_means():
    found = estimate(by_seed(a=[0, 1], b=[1, 2, 3], c=[4]))
    test = stats.ttest_1samp([0.5, 2, 4], 1.0, alternative="greater")
    assert found.p_value(1.0) == pytest.approx(test.pvalue)
    assert (found.value, found.units) == (pytest.approx(6.5 / 3), (0.5, 2, 4))


def test_pairs_need_both_values():
    found = paired(by_seed(a={0: 3, 1: 5}, b={0: 1}, c={0: 1}), by_seed(a={1: 2}, b={7: 0}))
    assert found.to_dict() == {("a", "1"): 3.0}


def successes(random, rates, starts=20):
    return random.binomial(starts, rates) / starts


def bimodal(random, tasks):
    """Tasks are easy or hard for both methods; a fit of either collapses in one of five seeds."""
    levels = np.where(random.random((tasks, 1)) < 0.5, 0.95, 0.15)
    ours, theirs = (np.where(random.random((tasks, 5)) < 0.2, 0.3, levels) for _ in range(2))
    return successes(random, ours) - successes(random, theirs)


def near_the_ceiling(random, tasks):
    """Both methods nearly always succeed, but theirs fails on one of seven tasks in most seeds."""
    fails = (random.random((tasks, 1)) < 0.15) & (random.random((tasks, 3)) < 0.7)
    return successes(random, np.full((tasks, 3), 0.97)) - successes(random, np.where(fails, 0.3, 0.95))


def rare_collapse(random, seeds):
    """One task: a fit of theirs collapses in one of ten seeds."""
    theirs = np.where(random.random((seeds, 1)) < 0.1, 0.3, 0.95)
    return successes(random, np.full((seeds, 1), 0.95), 50) - successes(random, theirs, 50)


def heavy_tails(random, tasks):
    """Nats: a few tasks have differences that are ten times those of the others."""
    return np.exp(random.normal(0, 1.5, (tasks, 1))) * random.normal(0.3, 0.5, (tasks, 1))


COVERAGE = {
    "twelve tasks, easy or hard": (bimodal, 12, 0.95),
    "nine tasks near the ceiling": (near_the_ceiling, 9, 0.76),
    "one task, a collapse in one of ten seeds; five seeds": (rare_collapse, 5, 0.56),
    "the same, ten seeds": (rare_collapse, 10, 0.63),
    "nine tasks, heavy-tailed nats": (heavy_tails, 9, 0.75),
}
"""Simulated differences, how many units a study has, and how many t intervals of 95 % cover the mean."""


@pytest.mark.parametrize("named", COVERAGE)
def test_intervals_of_differences_cover_as_the_docs_say(named):
    population, units, said = COVERAGE[named]
    random, studies = np.random.default_rng(4), 2000
    means = population(random, 100 * studies).mean(1)
    found = population(random, units * studies).mean(1).reshape(studies, units)
    low, high = stats.ttest_1samp(found, 0.0, axis=1).confidence_interval(0.95)
    assert estimate(by_seed(a=found[0])).interval == pytest.approx((low[0], high[0]))
    covered = np.mean((low <= means.mean()) & (means.mean() <= high))
    assert covered == pytest.approx(said, abs=0.025)  # two standard errors of 2000 studies are at most 0.022
    ranks, median = estimate(by_seed(a=range(units))).median[1], np.median(means)
    if units > 5:
        least, most = np.sort(found)[:, np.array(ranks, int)].T
        assert np.mean((least <= median) & (median <= most)) >= 0.95
    line = f"| {named} | {100 * said:.0f} % | {'95 % or more' if units > 5 else '–'} |"
    assert line in (ROOT / "docs" / "studies.md").read_text()


def test_holm_gives_what_hand_computation_gives():
    """0.01 · 4; 0.013 · 3 is below it; 0.03 · 2; 0.4."""
    assert holm([0.03, 0.01, 0.4, 0.013]) == pytest.approx([0.06, 0.04, 0.4, 0.04])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([float("nan"), 0.01]) == pytest.approx([1.0, 0.02])
    assert holm([]) == []


@pytest.mark.parametrize(
    ("p_values", "said"),
    [
        ([0.018], ["holds"]),
        ([0.982], ["does not hold"]),
        ([0.018, 0.982], ["inconclusive"] * 2),  # 2 × 0.018 > 0.025 on either side
        ([0.982, 0.982], ["inconclusive"] * 2),
        ([float("nan")], ["not tested"]),
        ([], []),
    ],
)
def test_both_sides_of_a_verdict_have_holms_correction(p_values, said):
    assert [verdict for verdict, _ in verdicts(p_values)] == said


@pytest.mark.parametrize(
    ("p_values", "said"),
    [
        ([0.01, 0.02, 0.3, 0.001], ["holds", "holds", "inconclusive", "not reached"]),
        ([0.02, 0.02, 0.02], ["holds"] * 3),  # Holm's first would be 0.06
        ([0.99, 0.001], ["does not hold", "not reached"]),
        ([0.001, 0.99, 0.001], ["holds", "does not hold", "not reached"]),
        ([0.001, float("nan"), 0.001], ["holds", "not tested", "not reached"]),
        ([], []),
    ],
)
def test_a_fixed_sequence_ends_where_a_contrast_does_not_hold(p_values, said):
    judged = verdicts(p_values, "fixed_sequence")
    assert [verdict for verdict, _ in judged] == said
    largest = [max(1.0 if np.isnan(p) else p for p in p_values[: n + 1]) for n in range(len(p_values))]
    assert [p for _, p in judged] == largest


HOLDS, UNCLEAR = "holds", "inconclusive"


@pytest.mark.parametrize(
    ("p_values", "said"),
    [
        ([0.01, 0.9, 0.02, 0.001], [HOLDS, UNCLEAR, HOLDS, HOLDS]),  # the last waits for its twin, 2
        ([0.01, 0.01, 0.3, 0.99], [HOLDS, HOLDS, UNCLEAR, "does not hold"]),
        ([0.4, 0.01, 0.01, 0.01], [UNCLEAR, HOLDS, "not reached", "not reached"]),
    ],
)
def test_equivalence_is_read_off_the_interval_of_its_twin(p_values, said):
    """Claims 1 and 3 are the equivalence of 0 and of 2."""
    assert [verdict for verdict, _ in verdicts(p_values, "fixed_sequence", {1: 0, 3: 2})] == said


def test_equivalence_is_an_interval_within_the_margin():
    random, spec = np.random.default_rng(7), {"contrast": "a - b", "measure": "nats", "kind": "equivalence"}
    told = set()
    for scale in (0.02, 0.1, 0.3):
        for _ in range(20):
            units = random.normal(random.choice([0.0, 0.3]), scale, 7)
            known = estimate(by_seed(push=units))
            contrast = ContrastSpec(**spec, margin=0.15)
            sides = (stats.ttest_1samp(units, bound, alternative=way).pvalue
                     for bound, way in ((-0.15, "greater"), (0.15, "less")))  # fmt: skip
            assert known.p_value(*contrast.bounds) == pytest.approx(max(sides))
            low, high = stats.ttest_1samp(units, 0).confidence_interval(0.95)
            within, beyond = -0.15 < low < high < 0.15, high < -0.15 or low > 0.15
            ((verdict, _),) = verdicts([known.p_value(*contrast.bounds)])
            assert verdict == ("holds" if within else "does not hold" if beyond else "inconclusive")
            told.add(verdict)
    assert len(told) == 3


def test_siblings_are_one_unit():
    """Door 0.5 and 2, by hand 1.25; window 4; push 1."""
    own = by_seed(open=[0, 1], close=[1, 2, 3], window=[4], push=[1])
    found = estimate(own, families={"door": ["open", "close"]})
    test = stats.ttest_1samp([1.25, 4, 1], 0.0, alternative="greater")
    assert found.units == (1.25, 4, 1)
    assert found.value == pytest.approx(6.25 / 3)
    assert found.p_value(0.0) == pytest.approx(test.pvalue)


def test_equal_units_have_the_interval_of_their_trials_or_none():
    """Wilson's for none of 60: 0 to z² / (60 + z²)."""
    most = 1.959964**2 / (60 + 1.959964**2)
    for value, lowest, interval in (
        (0.0, -1.0, (-most, most)),
        (0.0, 0.0, (0.0, most)),
        (1.0, 0.0, (1 - most, 1.0)),
        (-1.0, -1.0, (-1.0, most - 1)),
    ):
        found = estimate(by_seed(push=[value] * 3), trials=20, lowest=lowest)
        assert found.interval == pytest.approx(interval, abs=1e-6)
        assert (found.p_value(0.0) < 0.001) == (value > 0)
    for units in ([0.1 + 0.2, 0.3], [0.0] * 3, [1.0]):
        found = estimate(by_seed(push=units))
        assert np.isnan([*found.interval, found.p_value(0.0)]).all()
