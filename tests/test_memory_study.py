"""The study of memory: what is paired with what, against cases worked by hand, and what is done after a kill."""

from __future__ import annotations

import memory
import pytest
from memory import Asked, Cell, Measured, cells_of, compared, missing, work
from memory_results import ACTED, checks, comparisons, draw, everything, of_pages, over_tasks, page, short, with_table
from table import RESULTS, ROOT, read


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


def test_a_cell_is_kept_as_soon_as_it_is_done_and_not_done_again(tmp_path, monkeypatch):
    done = []

    def fitted(cell, runs):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(cell)
        return [Measured("", "nats", 1.5), Measured("marginal", "success", cell.seed / 10)]

    monkeypatch.setitem(memory.STUDIES, "needle", fitted)
    cells = cells_of("needle", Asked((20,), 3, 1, ("needle",)))
    assert [(cell.method, cell.seed) for cell in cells] == [
        ("mixture", 0),
        ("options", 0),
        ("mixture", 1),
        ("mixture", 2),
    ]
    table = tmp_path / "memory.csv"
    with pytest.raises(KeyboardInterrupt):
        work(cells, tmp_path, table)
    assert [row.value for row in read(table)] == [1.5, 0.0] * 2
    done.clear()
    assert work(cells, tmp_path, table) == "2 of 4 cells were not there"
    assert done == cells[2:]
    last = read(table)[-1]
    assert Cell(*last[:5]) == cells[-1]
    assert last[5:] == ("success, acting by marginal", 0.2)
    (line,) = (one for one in missing(set(cells)) if "needle --counts 20 " in one)
    assert line.endswith("7 of mixture, 1 of options, of 12 cells")


NEEDLE = ("needle", "needle", "ddco", 100, "nats")


def test_the_tables_of_the_studies_are_read_by_seed():
    found = of_pages()
    assert {row["study"] for row in found} == set(memory.STUDIES)
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
    text = page(found, checks(rows("options", {0: 0.8}), pages), ["`a command`: 3 of mixture"])
    assert "| needle | 20 | success | - | - | 55% | 85% | - | - | - | **+30% [+30%, +30%]** | - | 2 |" in text
    assert "- needle, 1 cell of options again: success reproduced: 1 of 1." in text
    assert text.endswith("- `a command`: 3 of mixture\n")
    draw(everything(found), tmp_path / "memory.png")
    assert (tmp_path / "memory.png").read_bytes().startswith(b"\x89PNG")


def test_the_table_of_readme_is_that_of_the_page():
    found, _ = compared()
    readme = (ROOT / "README.md").read_text()
    assert with_table(readme, short(found)) == readme
    assert short(found).count("\n") == 1 + len(ACTED)
    other = with_table(readme, "other")
    assert other == readme.replace(short(found), "other") != readme  # what stands around the table stays
    with pytest.raises(ValueError, match="substring not found"):
        with_table("no table", "other")
