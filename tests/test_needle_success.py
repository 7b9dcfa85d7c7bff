"""What the study of the needle says of training seeds, against simulation and a case worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from needle_success import POOLED, differences, over_seeds, page, summarize

SEEDS, DRAWS = 5, 4000


def test_intervals_hold_what_they_say_in_95_percent_of_studies():
    """Of studies with normally distributed seeds: the true mean, and what another fit gives."""
    random = np.random.default_rng(0)
    held = {"interval": 0, "another": 0}
    for values in random.normal(3.0, 0.5, (DRAWS, SEEDS)):
        found, truth = over_seeds(values.tolist()), {"interval": 3.0, "another": random.normal(3.0, 0.5)}
        for name, (low, high) in ((key, found[key]) for key in held):
            held[name] += low <= truth[name] <= high
    error = np.sqrt(0.95 * 0.05 / DRAWS)
    assert all(abs(count / DRAWS - 0.95) < 3 * error for count in held.values()), held


def rates(success, grasped, inserted, accuracy):
    """Measures of a method, of (successes, trials) each."""
    counts = {"success": success, "grasped": grasped, "inserted": inserted}
    measures = {
        name: {"successes": n, "trials": of, "rate": n / of if of else None} for name, (n, of) in counts.items()
    }
    return {"measures": measures | {"accuracy_mm": {"mean": accuracy, "trials": inserted[0]}}}


@pytest.fixture
def seeds():
    scripted = {
        "open_loop": rates((1, 10), (2, 10), (1, 2), 5.0),
        "supervisor": rates((10, 10), (10, 10), (10, 10), 0.5),
    }
    likelihoods = ((20.0, 21.0), (22.0, 25.0))
    learned = (
        {"flat": rates((2, 10), (4, 10), (2, 4), 1.0), "ddco": rates((3, 10), (5, 10), (3, 5), 0.8)},
        {"flat": rates((4, 10), (0, 10), (0, 0), None), "ddco": rates((8, 10), (9, 10), (8, 9), 0.6)},
    )
    return [
        {
            "methods": (scripted if number == 0 else {}) | methods,
            "log_likelihood_per_step": {
                name: {"train": value + 1, "valid": value} for name, value in zip(("flat", "ddco"), values, strict=True)
            },
            "training": {"flat": {"converged": number == 0}, "ddco": {"converged": True}},
        }
        for number, (methods, values) in enumerate(zip(learned, likelihoods, strict=True))
    ]


def test_learned_methods_vary_over_seeds_and_scripted_ones_over_episodes(seeds):
    found = summarize(seeds)
    assert list(found) == ["open_loop", "flat", "ddco", "supervisor"]
    flat = found["flat"]["success"]
    assert (flat["successes"], flat["trials"], flat["by_seed"], flat["range"]) == (6, 20, [0.2, 0.4], [0.2, 0.4])
    assert flat["mean"] == pytest.approx(0.3)
    # t(0.975, 1) = 12.706 times the standard error 0.1 goes beyond what a rate can be
    assert flat["interval"] == [0.0, 1.0]
    likelihood = found["flat"]["log_likelihood_valid"]
    assert likelihood["interval"] == pytest.approx([21 - 12.7062, 21 + 12.7062], abs=1e-3)
    assert likelihood["another"] == pytest.approx([21 - 12.7062 * 3**0.5, 21 + 12.7062 * 3**0.5], abs=1e-3)
    assert found["flat"]["inserted"]["by_seed"] == [0.5]  # the other seed has grasped nothing
    assert found["flat"]["accuracy_mm"]["by_seed"] == [1.0]
    assert (found["flat"]["not_converged"], found["ddco"]["not_converged"]) == (1, 0)
    scripted = found["open_loop"]["success"]
    assert "by_seed" not in scripted
    assert scripted["interval"] == pytest.approx([0.0179, 0.4042], abs=1e-4)  # Wilson's of 1 in 10
    assert "log_likelihood_valid" not in found["open_loop"]


def test_differences_are_paired_by_seed(seeds):
    (name, found), *others = differences(seeds).items()
    assert (name, others) == ("flat", [])
    assert found["success"]["by_seed"] == pytest.approx([0.1, 0.4])
    assert found["log_likelihood_valid"]["by_seed"] == pytest.approx([1.0, 3.0])


def test_the_two_fits_of_one_flat_network_are_pooled_by_seed(seeds):
    for one in seeds:
        one["methods"]["flat_equal"] = rates((1, 10), (4, 10), (2, 4), 1.0)
        one["log_likelihood_per_step"]["flat_equal"] = {"train": 20.0, "valid": 18.0}
    found = differences(seeds)[POOLED]
    assert found["success"]["by_seed"] == pytest.approx([0.3 - 0.15, 0.8 - 0.25])
    assert found["log_likelihood_valid"]["by_seed"] == pytest.approx([21.0 - 19.0, 25.0 - 20.0])
    assert "one network" in page({"methods": summarize(seeds), "differences": differences(seeds)}, 2, "Made.")
