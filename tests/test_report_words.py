"""Numbers, stages, verdicts and tables in the words of the report."""

from dataclasses import replace

import numpy as np
import pytest
import toy_task
from made_metrics import compared, made_metrics

from ddco_pyro.drawing import words
from ddco_pyro.metrics import Method
from ddco_pyro.report.rollouts import measures_table
from ddco_pyro.simulation.episodes import summarize


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("vq-1", "level 1 from clusters"),
        ("level-2", "level 2 alone"),
        ("meta-policy", "meta-policy alone"),
        ("joint", "all together"),
        ("policy", "policy"),
    ],
)
def test_stages_in_words(name, said):
    assert words.stage(name) == said


def test_a_column_is_of_one_kind_whatever_was_seen():
    """A method that toppled 0 or 1 boxes in each episode beside one that toppled more, and one that grasped nothing."""
    task = replace(toy_task.task, measures={"topples": "mean", "inserted": "rate", "accuracy_mm": "mean"})
    seen = {
        "flat": [{"topples": 0.0, "inserted": np.nan, "accuracy_mm": np.nan}] * 2,
        "ddco": [{"topples": 3.0, "inserted": 1.0, "accuracy_mm": 1.0}] * 2,
    }
    found = measures_table({name: Method(measures=summarize(task, outcomes)) for name, outcomes in seen.items()})
    assert found.head == ["Method", "Topples", "Inserted", "Accuracy (mm)"]
    assert found.rows == [
        ["flat", "0.00 ± 0.00 [0.00 to 0.00], n = 2", "0 of 0", "– (n = 0)"],
        ["DDCO", "3.00 ± 0.00 [3.00 to 3.00], n = 2", "2 of 2 (34 to 100 %)", "1.00 ± 0.00 [1.00 to 1.00], n = 2"],
    ]


@pytest.mark.parametrize(
    ("mean", "error", "held_out", "said"),
    [
        (0.42, 0.05, 10, "0.42 ± 0.05 nats per step better than flat"),
        (-0.42, 0.05, 10, "0.42 ± 0.05 nats per step worse than flat"),
        (0.1, 0.05, 10, "with no clear difference from flat (+0.10 ± 0.05 nats per step)"),
        (0.1, 0.04, 100, "0.10 ± 0.04 nats per step better than flat"),
        (0.1, 0.04, 3, "with no clear difference from flat"),
        (0.1, None, 1, "0.10 nats per step better than flat (error unknown) (1 held-out demonstration, one fit"),
    ],
)
def test_the_verdict_is_honest(mean, error, held_out, said):
    assert said in words.verdict(made_metrics(held_out, comparison={"flat": compared(mean, error)}))


def test_numbers_in_words():
    assert [words.number(one) for one in (None, float("nan"), -1.234, -0.001)] == ["–", "–", "−1.23", "0.00"]
    assert [words.signed(one) for one in (1.0, -1.0, 0.0)] == ["+1.00", "−1.00", "0.00"]
    assert [words.p_value(one) for one in (0.0004, 0.0123, 1.0)] == ["< 0.001", "0.012", "1"]
    assert [words.measure(one) for one in ("success", "accuracy_mm", "picked_up")] == [
        "Success",
        "Accuracy (mm)",
        "Picked up",
    ]
