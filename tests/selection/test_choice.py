"""From scores to a choice, against sums by hand: means, paired differences, standard errors, two rules."""

import math
import re
from collections import ChainMap
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from selecting import DATA, candidate, scored, spec_at, two_skills

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.selection.choice import as_data, choose, markdown, table
from ddco_pyro.selection.grid import assign, candidates, divide, wide
from ddco_pyro.spec import SpecError, parse_spec, with_overrides
from ddco_pyro.training.networks import Dimensions


def rows(values, lengths=(10,), parameters=None):
    """The choice among candidates with these log-likelihoods per step, one row each, one column per fold."""
    fits = {}
    for c, row in enumerate(values):
        for f, value in enumerate(row):
            fits |= {(c, f): value} if isinstance(value, str) else scored(c, f, value, lengths)
    sizes = parameters or [None] * len(values)
    return choose([candidate(c, size) for c, size in enumerate(sizes)], fits)


def pair(row):
    return row.difference.nats_per_step, row.difference.standard_error


def test_means_and_standard_errors_are_those_of_the_folds():
    each = np.array([[1.0, 2.0, 4.0, 1.0], [1.5, 2.0, 5.0, 1.5]])
    found = rows(each.tolist(), lengths=(3, 7))
    for row, values in zip(found.rows, each, strict=True):
        assert row.mean == pytest.approx(values.mean())
        assert row.error == pytest.approx(values.std(ddof=1) / 2)
        assert list(row.folds.values()) == pytest.approx(values.tolist())
    difference = each[0] - each[1]
    assert found.best is found.rows[1]
    assert pair(found.rows[0]) == pytest.approx((difference.mean(), difference.std(ddof=1) / 2))
    assert pair(found.rows[1]) == (0.0, 0.0)


def test_the_mean_is_over_steps_and_not_over_folds():
    fits = scored(0, 0, 1.0, (2,)) | scored(0, 1, 4.0, (6,)) | scored(0, 2, 2.0, (4,))
    row = choose([candidate(0)], fits).rows[0]
    assert row.mean == pytest.approx((2 * 1 + 6 * 4 + 4 * 2) / 12)
    residual = np.array([2 * 1, 6 * 4, 4 * 2]) - row.mean * np.array([2, 6, 4])
    assert row.error == pytest.approx(math.sqrt((residual**2).sum() / 2 * 3) / 12)  # that of a ratio of sums


def test_the_choice_is_the_smallest_within_one_standard_error_of_the_best():
    base = np.array([0.0, 1.0, 2.0, 3.0])
    error = base.std(ddof=1) / 2  # 0.645
    found = rows([(base - 0.66).tolist(), (base - 0.63).tolist(), base.tolist(), (base - 0.01).tolist()])
    assert found.best.error == pytest.approx(error)
    assert (found.best.candidate.number, found.chosen.candidate.number) == (2, 1)
    within = [row["within_one_standard_error"] for row in as_data(found)["candidates"]]
    assert within == [False, True, True, True]


def test_the_paired_difference_is_shown_and_not_the_rule():
    """The smaller one is below the best in every fold, and yet within the error of the best's mean."""
    base = np.array([0.0, 1.0, 2.0, 3.0])
    found = rows([(base - 0.1).tolist(), base.tolist()])
    assert pair(found.rows[0]) == pytest.approx((-0.1, 0.0), abs=1e-12)
    assert (found.best, found.chosen) == (found.rows[1], found.rows[0])


def test_among_equal_sizes_the_better_one_is_chosen():
    base = np.array([0.0, 1.0, 2.0])
    found = rows([(base - 0.02).tolist(), (base - 0.01).tolist(), base.tolist()], parameters=[5, 5, 9])
    assert (found.best.candidate.number, found.chosen.candidate.number) == (2, 1)


def test_a_candidate_with_a_failed_fold_is_named_and_not_chosen():
    found = rows([[9.0, "it diverged"], [1.0, 2.0]])
    assert [sorted(row.failed) for row in found.rows] == [[1], []]
    assert found.best is found.chosen is found.rows[1]
    data = as_data(found)
    assert data["failed"] == [{"candidate": 0, "name": "count = 1", "fold": 1, "reason": "it diverged"}]
    text = markdown(found, {**data, "folds": 2, "demonstrations": 2})
    assert "**Failed:** count = 1, fold 1: it diverged" in text
    assert table(found).rows[0][-1] == "failed"


def test_where_all_have_failed_there_is_no_choice():
    found = rows([[1.0, "out of memory"], ["x", "x"]])
    assert found.best is found.chosen is as_data(found)["best"] is None
    assert [row.mean for row in found.rows] == [1.0, None]


COUNT = "hierarchy.levels.0.count"


@pytest.mark.parametrize(
    ("path", "grid", "means", "said"),
    [
        (COUNT, [1, 2, 4], [0.0, 1.0, 2.0], "count = 4 is the best, and the largest of the grid"),
        (COUNT, [2, 3, 4], [2.0, 1.0, 0.0], "count = 2 is the best, and the smallest of the grid"),
        ("control.std", [0.1, 0.2], [0.0, 1.0], "std = 0.2 is the best, and the largest"),
        (COUNT, [1, 2, 4], [0.0, 3.0, 2.0], ""),
        (COUNT, [1, 2], [1.0, 0.0], ""),
        ("observations", [["a"], ["a", "b"]], [0.0, 1.0], ""),
    ],
)
def test_a_best_candidate_at_the_edge_of_the_grid_is_noted(path, grid, means, said):
    each = [replace(candidate(c), values={path: value}) for c, value in enumerate(grid)]
    fits = ChainMap(*(scored(c, f, mean) for c, mean in enumerate(means) for f in (0, 1)))
    made = choose(each, fits)
    noted = " ".join(made.notes)
    assert noted.startswith(said)
    assert bool(noted) == bool(said)
    assert ("likelihood does not count skills" in noted) == ("count" in noted)
    assert noted in markdown(made, as_data(made) | {"folds": 2, "demonstrations": 4})


def test_different_fixed_errors_are_noted():
    def fixed(std):
        return parse_spec({**DATA, "demonstrations": {"path": "x"}, "control": {"std": std}})

    both = [candidate(0, spec=fixed(0.1)), candidate(1, spec=fixed(0.2))]
    fits = scored(0, 0, 1.0) | scored(0, 1, 1.0) | scored(1, 0, 1.0) | scored(1, 1, 1.0)
    assert "control.std differs" in choose(both, fits).notes[0]
    assert choose([both[0], both[0]], fits).notes == []


# --- candidates: every point of the grid --------------------------------------------------------------------


PLACE, TURN = {"place": (2,)}, {"turn": (1,)}
SIZE = Dimensions(PLACE | TURN, 2, 10)


def with_grid(grid, **changes):
    chosen = {"demonstrations": {"path": "demos.hdf5"}, "selection": {"grid": grid}}
    return parse_spec({**DATA, **chosen, **changes})


def test_every_point_of_the_grid_is_a_candidate():
    """With k linear policies from 3 features to 2 controls, k terminations, a meta-policy over options."""
    grid = {"hierarchy.levels.0.count": [1, 3], "control.std": [0.1, 0.2, 0.5]}
    spec = with_grid(grid, compare_with=["flat"])
    found = candidates(spec, SIZE)
    assert [one.number for one in found] == list(range(6))
    points = [(k, std) for k in (1, 3) for std in (0.1, 0.2, 0.5)]
    assert [tuple(one.values.values()) for one in found] == points
    assert [one.parameters for one in found] == [
        k * (3 * 2 + 2) + k * (3 + 1) + (3 + 1) * k for k in (1, 1, 1, 3, 3, 3)
    ]
    assert found[4].name == "count = 3, std = 0.2"
    expected = {"hierarchy.levels.0.count": 3, "control.std": 0.2, "selection.grid": {}, "compare_with": []}
    assert found[4].spec == with_overrides(spec, expected)


def test_demonstrations_are_read_with_what_any_candidate_sees(tmp_path):
    spec = spec_at(tmp_path, grid={"observations": [["place"], ["turn"]]})
    assert {one.key for one in wide(spec).observations} == {"place", "turn"}
    assert [[o.key for o in one.spec.observations] for one in candidates(spec, SIZE)] == [["place"], ["turn"]]


EMPTY = "selection.grid: is empty; name what to try, such as selection.grid: {hierarchy.levels.0.count: .*}"
OF_DATA = {"demonstrations.count": [3], "training.epochs": [1]}
MISSPELT = [r"selection.grid: observations=\['palce'\]: .*no palce.*", r"selection.grid: .*no tern.*"]


@pytest.mark.parametrize(
    ("grid", "problems"),
    [
        ({}, [EMPTY]),
        ({"task": ["needle"]}, ["selection.grid.task: candidates are compared on the same data; remove it"]),
        (OF_DATA, ["selection.grid.demonstrations.count: candidates .*"]),
        ({"observations": [["place"], ["palce"], ["tern"]]}, MISSPELT),
    ],
)
def test_what_is_refused_has_a_line_each(grid, problems):
    with pytest.raises(SpecError) as refused:
        candidates(with_grid(grid), SIZE)
    assert len(refused.value.problems) == len(problems)
    for found, expected in zip(refused.value.problems, problems, strict=True):
        assert re.fullmatch(expected, found)


# --- folds --------------------------------------------------------------------------------------------------


@given(st.data())
def test_folds_are_an_even_partition(data):
    count = data.draw(st.integers(4, 60))
    folds, seed = data.draw(st.integers(2, count)), data.draw(st.integers(0, 2**32 - 1))
    several = st.lists(st.sampled_from("abc"), min_size=count, max_size=count)
    tasks = data.draw(several | st.just([""] * count))
    found = assign(tasks, folds, seed)
    assert sorted(row for rows in found for row in rows) == list(range(count))
    assert {len(rows) for rows in found} <= {count // folds, -(-count // folds)}
    assert found == assign(tasks, folds, seed)
    if len({*tasks}) <= count / 2:
        for task in {*tasks}:
            shares = [sum(tasks[row] == task for row in rows) for rows in found]
            assert max(shares) - min(shares) <= 1


@pytest.mark.parametrize(
    ("count", "folds", "message"),
    [
        (9, 10, "selection.folds: 10 folds of 9 demonstrations; use at most 9"),
        (2, 2, "selection.folds: 2 folds of 2 demonstrations leave less than 2 to train with"),
    ],
)
def test_too_few_demonstrations_are_refused(count, folds, message):
    with pytest.raises(BadInput, match=f"^{message}$"):
        assign([""] * count, folds, 0)


def test_what_its_author_set_apart_is_in_no_fold():
    demos = two_skills(10)
    marked = Demonstrations(demos.demonstrations, {"valid": ("demo_3", "demo_7")})
    held_out = [fold.masks["valid"] for fold in divide(marked, 4, 0)]
    used = {*demos.names} - {"demo_3", "demo_7"}
    assert sorted(name for names in held_out for name in names) == sorted(used)
    assert all({*fold.masks["train"]} == used - {*fold.masks["valid"]} for fold in divide(marked, 4, 0))
