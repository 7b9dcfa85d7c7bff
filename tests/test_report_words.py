"""Numbers, stages, verdicts and tables in the words of the report."""

import pytest
from made_metrics import compared, made_metrics

from ddco_pyro.drawing import words


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
