"""Statistics of studies against scipy's tests, hand-computed values, and planted truths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ddco_pyro.study.statistics import bootstrap, estimate, holm, p_value, paired


def by_seed(values):
    return dict(enumerate(map(float, values)))


def test_one_task_is_the_paired_t_test_over_seeds():
    random = np.random.default_rng(0)
    ours, theirs = random.normal(0.3, 1, 8), random.normal(0, 1, 8)
    found = estimate(paired({"push": by_seed(ours)}, {"push": by_seed(theirs)}))
    for bound in (0.0, 0.2, -0.1):
        test = stats.ttest_rel(ours, theirs + bound, alternative="greater")
        assert p_value(found, bound) == pytest.approx(test.pvalue)
    interval = stats.ttest_rel(ours, theirs).confidence_interval(0.95)
    assert found.interval == pytest.approx((interval.low, interval.high))
    assert (found.freedom, found.units) == (7, pytest.approx(tuple(ours - theirs)))


def test_the_units_of_several_tasks_are_their_means():
    tasks = {"a": by_seed([0, 1]), "b": by_seed([1, 2, 3]), "c": by_seed([4])}
    found, test = estimate(tasks), stats.ttest_1samp([0.5, 2, 4], 1.0, alternative="greater")
    assert p_value(found, 1.0) == pytest.approx(test.pvalue)
    assert (found.value, found.freedom, found.range) == (pytest.approx(6.5 / 3), 2, (0.5, 4))


def test_pairs_need_both_values():
    found = paired({"a": {0: 3.0, 1: 5.0}, "b": {0: 1.0}, "c": {0: 1.0}}, {"a": {1: 2.0}, "b": {7: 0.0}})
    assert found == {"a": {1: 3.0}}


def test_the_bootstrap_is_that_of_scipy_where_there_is_one_task():
    values = np.random.default_rng(1).normal(size=12)
    low, high = bootstrap({"push": by_seed(values)})
    random = np.random.default_rng(2)
    theirs = stats.bootstrap([values], np.mean, method="percentile", n_resamples=5000, rng=random).confidence_interval
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=0.05)


def test_the_bootstrap_draws_tasks_and_seeds():
    """Its variance is that of tasks' means among tasks, and that of seeds within tasks."""
    random = np.random.default_rng(3)
    values = random.normal(size=(12, 1)) + random.normal(size=(12, 5))
    low, high = bootstrap({str(n): by_seed(own) for n, own in enumerate(values)})
    variance = (values.mean(1).var() + values.var(1).mean() / 5) / 12
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(variance), rel=0.08)


def test_intervals_cover_the_mean_of_bimodal_results():
    """Tasks are easy (0.95) or hard (0.15), seeds succeed or collapse: 12 tasks of 5 seeds."""
    random, studies = np.random.default_rng(4), 400
    truth = 0.5 * (0.8 * 0.95 + 0.2 * 0.3) + 0.5 * (0.8 * 0.15 + 0.2 * 0.3)
    covered = np.zeros(2)
    for study in range(studies):
        level = np.where(random.random((12, 1)) < 0.5, 0.95, 0.15)
        rates = np.where(random.random((12, 5)) < 0.2, 0.3, level)
        values = random.binomial(50, rates) / 50
        tasks = {str(n): by_seed(own) for n, own in enumerate(values)}
        for number, (low, high) in enumerate((estimate(tasks).interval, bootstrap(tasks, 400, study))):
            covered[number] += low <= truth <= high
    assert 0.92 <= covered[0] / studies <= 0.98  # two standard errors of 400 studies are 0.022
    assert 0.88 <= covered[1] / studies <= 0.98  # a percentile interval of twelve units is somewhat short


@pytest.mark.parametrize(("seeds", "covered"), [(5, 0.67), (10, 0.88)])
def test_few_seeds_that_may_collapse_are_too_few(seeds, covered):
    """One task: a fit collapses in one of five seeds, so none of five does so with probability 0.8⁵ = 0.33."""
    random, studies = np.random.default_rng(6), 500
    rates = np.where(random.random((studies, seeds)) < 0.2, 0.3, 0.95)
    found = [estimate({"push": by_seed(own)}).interval for own in random.binomial(50, rates) / 50]
    assert sum(low <= 0.82 <= high for low, high in found) / studies == pytest.approx(covered, abs=0.05)


def test_a_test_errs_as_often_as_its_level_says():
    random, wrong = np.random.default_rng(5), 0
    for _ in range(1000):
        tasks = random.choice([-0.3, 0.3], (8, 1)) + random.normal(0, 0.1, (8, 3))
        wrong += p_value(estimate({str(n): by_seed(own) for n, own in enumerate(tasks)}), 0.0) <= 0.025
    assert 0.01 <= wrong / 1000 <= 0.04  # two standard errors of 1000 studies are 0.01


def test_holm_gives_what_hand_computation_gives():
    """0.01 · 4; 0.013 · 3 is below it; 0.03 · 2; 0.4."""
    assert holm([0.03, 0.01, 0.4, 0.013]) == pytest.approx([0.06, 0.04, 0.4, 0.04])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([float("nan"), 0.01]) == pytest.approx([1.0, 0.02])
    assert holm([]) == []


@pytest.mark.parametrize(("value", "p"), [(0.1, 0.0), (0.0, 1.0), (-0.1, 1.0)])
def test_equal_values_are_certain(value, p):
    assert p_value(estimate({"push": by_seed([value] * 3)}), 0.0) == pytest.approx(p)


def test_a_single_value_has_no_interval():
    found = estimate({"push": {0: 1.0}})
    assert found.value == 1
    assert np.isnan([*found.interval, p_value(found, 0.0)]).all()
