"""The study of memory: what is paired with what, against cases worked by hand."""

from __future__ import annotations

import pytest
from memory import SOURCES, comparisons, of_pages, over_tasks
from table import RESULTS, read


def rows(method, values, study="needle", measure="success", acting="marginal", task=None, count=20):
    named = {"study": study, "task": task or study, "method": method, "demonstrations": count}
    named |= {"acting": acting, "measure": measure}
    return [named | {"seed": seed, "value": value} for seed, value in values.items()]


def test_differences_are_paired_by_seed_with_t_intervals():
    pages = [*rows("flat", {0: 0.2, 1: 0.3, 2: 0.1, 7: 0.9}), *rows("options", {0: 0.5, 1: 0.5, 2: 0.8, 7: 0.0})]
    (found,) = comparisons(rows("mixture", {0: 0.3, 1: 0.5, 2: 0.4}), pages)
    # Mixtures are 0.1, 0.2 and 0.3 above flat: mean 0.2, standard error 0.1 / √3, t(0.975, 2) = 4.302653.
    own = found["difference"]["mixture - flat"]
    assert own["mean"] == pytest.approx(0.2)
    assert own["interval"] == pytest.approx([0.2 - 0.248414, 0.2 + 0.248414], abs=1e-6)
    assert found["difference"]["options - mixture"]["by_seed"] == pytest.approx([0.2, 0.0, 0.4])
    assert found["difference"]["mixture - flat_equal"]["mean"] is None
    assert found["mean"]["flat"]["mean"] == pytest.approx(0.2)  # of the mixture's seeds alone


def test_several_tasks_have_intervals_over_tasks():
    pages = [
        *rows("options", {0: 1.0, 1: 0.8}, "arena", task="a"),
        *rows("options", {0: 0.3, 1: 0.5}, "arena", task="b"),
    ]
    mixtures = [
        *rows("mixture", {0: 0.5, 1: 0.5}, "arena", task="a"),
        *rows("mixture", {0: 0.3, 1: 0.3}, "arena", task="b"),
    ]
    (whole,) = over_tasks(comparisons(mixtures, pages))
    own = whole["difference"]["options - mixture"]  # 0.4 and 0.1; t(0.975, 1) = 12.7062
    assert (own["mean"], own["by_seed"]) == (pytest.approx(0.25), pytest.approx([0.4, 0.1]))
    assert own["interval"] == pytest.approx([0.25 - 12.7062 * 0.15, 0.25 + 12.7062 * 0.15], abs=1e-4)


NEEDLE = ("needle", "needle", "ddco", 100, "nats")


def test_the_tables_of_the_studies_are_read_by_seed():
    found = of_pages()
    assert {row["study"] for row in found} == set(SOURCES)
    named = [tuple(value for key, value in row.items() if key != "value") for row in found]
    assert len(set(named)) == len(named)
    kept = {row.seed: row.value for row in read(RESULTS / "needle.csv") if row[:4] + row[5:6] == NEEDLE}
    own = ("needle", "options", 100, "nats")
    assert kept == {one["seed"]: one["value"] for one in found
                    if tuple(one[key] for key in ("study", "method", "demonstrations", "measure")) == own}  # fmt: skip
