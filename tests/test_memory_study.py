"""The study of memory: what is paired with what, against cases worked by hand."""

from __future__ import annotations

import pytest
from memory import SOURCES, checks, comparisons, draw, everything, of_pages, over_tasks, page
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


def test_options_of_the_page_and_options_again_are_apart():
    pages, again = rows("options", {0: 0.5, 1: 0.5}), rows("options", {1: 0.7})
    (found,) = comparisons([*rows("mixture", {0: 0.1, 1: 0.2}), *again], pages)
    assert found["difference"]["options - mixture"]["by_seed"] == pytest.approx([0.4, 0.3])
    assert found["difference"]["options again - mixture"]["by_seed"] == pytest.approx([0.5])
    assert [(one["seed"], one["value"], one["kept"]) for one in checks(again, pages)] == [(1, 0.7, 0.5)]


def test_a_way_of_acting_is_compared_with_itself_and_with_flat_policies():
    pages = [*rows("flat", {0: 9.0}, "pushing", "goals"), *rows("options", {0: 20.0}, "pushing", "goals")]
    mixtures = [
        *rows("mixture", {0: 7.0}, "pushing", "goals"),
        *rows("mixture", {0: 5.0}, "pushing", "goals", "sample"),
    ]
    by_acting = {one["acting"]: one["difference"] for one in comparisons(mixtures, pages)}
    assert by_acting["sample"]["mixture - flat"]["by_seed"] == [-4.0]
    assert by_acting["sample"]["options - mixture"]["mean"] is None  # its page has marginal alone
    assert by_acting["marginal"]["options - mixture"]["by_seed"] == [13.0]


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


def test_the_page_and_the_figure_have_every_study(tmp_path):
    measured = [("needle", "success"), ("pushing", "goals"), ("arena", "NMI"), ("bins", "success"), ("planted", "nats")]
    mixtures = [row for study, measure in measured for row in rows("mixture", {0: 0.5, 1: 0.6}, study, measure)]
    pages = [row for study, measure in measured for row in rows("options", {0: 0.8, 1: 0.9}, study, measure)]
    found = comparisons(mixtures, pages)
    text = page(found, checks(rows("options", {0: 0.8}), pages))
    assert "| needle | 20 | success | - | - | 55% | 85% | - | - | - | **+30% [+30%, +30%]** | - | 2 |" in text
    assert "- needle, 1 cell of options again: success reproduced: 1 of 1." in text
    draw(everything(found), tmp_path / "memory.png")
    assert (tmp_path / "memory.png").read_bytes().startswith(b"\x89PNG")
