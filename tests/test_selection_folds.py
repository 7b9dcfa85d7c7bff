"""Folds: a partition that depends on the seed alone, never touches what was set apart, and is kept with the results."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from selecting import two_skills

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.selection.folds import FoldError, assign, divide, keep_folds


@given(st.data())
def test_folds_are_an_even_partition(data):
    count = data.draw(st.integers(4, 60))
    folds, seed = data.draw(st.integers(2, count)), data.draw(st.integers(0, 2**32 - 1))
    found = assign(count, folds, seed)
    assert sorted(row for rows in found for row in rows) == list(range(count))
    assert {len(rows) for rows in found} <= {count // folds, -(-count // folds)}
    assert found == assign(count, folds, seed)


def test_another_seed_divides_otherwise():
    assert assign(30, 5, 0) != assign(30, 5, 1)


@pytest.mark.parametrize(
    ("count", "folds", "message"),
    [
        (9, 10, "selection.folds: 10 folds of 9 demonstrations; use at most 9"),
        (2, 2, "selection.folds: 2 folds of 2 demonstrations leave less than 2 to train with"),
    ],
)
def test_too_few_demonstrations_are_refused(count, folds, message):
    with pytest.raises(FoldError, match=f"^{message}$"):
        assign(count, folds, 0)


def test_a_split_keeps_the_held_out_ones_out():
    demos = two_skills(11)
    folds = divide(demos, 4, 3)
    assert sorted(name for names in folds.held_out for name in names) == sorted(demos.names)
    for fold in range(4):
        train, held_out = folds.split(fold)
        assert held_out.names == folds.held_out[fold]
        assert set(train.names) == set(demos.names) - set(held_out.names)
    assert folds.dimensions.steps == max(demos.lengths)


def test_what_its_author_set_apart_is_in_no_fold():
    demos = two_skills(10)
    marked = Demonstrations(demos.demonstrations, {"valid": ("demo_3", "demo_7")})
    folds = divide(marked, 4, 0)
    assert sorted(name for names in folds.held_out for name in names) == sorted({*demos.names} - {"demo_3", "demo_7"})


def test_other_folds_are_refused(tmp_path):
    path = tmp_path / "folds.json"
    folds = divide(two_skills(6), 3, 0)
    keep_folds(folds, path)
    before = path.read_bytes()
    assert json.loads(before)["folds"] == [list(names) for names in folds.held_out]
    keep_folds(folds, path)
    with pytest.raises(FoldError, match=r"folds\.json: another version divided these .*; choose another --out"):
        keep_folds(divide(two_skills(6), 3, 1), path)
    assert path.read_bytes() == before
