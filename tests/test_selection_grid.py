"""The candidates of a selection: every point of the grid, named, valid, and refused with the reason."""

from __future__ import annotations

import re

import pytest
from selecting import DATA, spec_at

from ddco_pyro.selection.grid import candidates, wide
from ddco_pyro.spec import SpecError, parse_spec, with_overrides
from ddco_pyro.training.networks import Dimensions

PLACE, TURN = {"place": (2,)}, {"turn": (1,)}
SIZE = Dimensions(PLACE | TURN, 2, 10)

LEVEL = DATA["hierarchy"]["levels"][0]
PHASE = {**LEVEL, "name": "phase", "count": 3}


def with_grid(grid, **changes):
    return parse_spec({**DATA, "demonstrations": {"path": "demos.hdf5"}, "selection": {"grid": grid}, **changes})


def test_every_point_of_the_grid_is_a_candidate():
    spec = with_grid({"hierarchy.levels.0.count": [1, 3], "control.std": [0.1, 0.2, 0.5]})
    found = candidates(spec, SIZE)
    assert [one.number for one in found] == list(range(6))
    assert [tuple(one.values.values()) for one in found] == [(k, std) for k in (1, 3) for std in (0.1, 0.2, 0.5)]
    assert found[4].name == "count = 3, std = 0.2"
    expected = {"hierarchy.levels.0.count": 3, "control.std": 0.2, "selection.grid": {}}
    assert found[4].spec == with_overrides(spec, expected)


def test_parameters_are_counted():
    """k linear policies from 3 features to 2 controls and k terminations, and a meta-policy over k options."""
    for one in candidates(with_grid({"hierarchy.levels.0.count": [1, 2, 5]}), SIZE):
        k = one.spec.hierarchy.levels[0].count
        assert one.parameters == k * (3 * 2 + 2) + k * (3 + 1) + (3 + 1) * k


def test_the_number_of_levels_is_a_field_too():
    found = candidates(with_grid({"hierarchy.levels": [[LEVEL], [LEVEL, PHASE]]}), SIZE)
    assert [len(one.spec.hierarchy.levels) for one in found] == [1, 2]
    assert [one.name for one in found] == ["levels = [2]", "levels = [2, 3]"]
    assert found[0].parameters < found[1].parameters


def test_names_tell_equal_ends_of_key_paths_apart():
    grid = {"hierarchy.levels.0.policy.network": ["linear"], "hierarchy.meta_policy.network": ["linear", "mlp"]}
    assert candidates(with_grid(grid), SIZE)[1].name == "policy.network = linear, meta_policy.network = mlp"


def test_baselines_are_compared_and_not_selected():
    spec = with_grid({"training.epochs": [1]}, compare_with=["flat"])
    assert candidates(spec, SIZE)[0].spec.compare_with == ()


def test_demonstrations_are_read_with_what_any_candidate_sees(tmp_path):
    spec = spec_at(tmp_path, grid={"observations": [["place"], ["turn"]]})
    assert {one.key for one in wide(spec).observations} == {"place", "turn"}
    assert [[o.key for o in one.spec.observations] for one in candidates(spec, SIZE)] == [["place"], ["turn"]]


@pytest.mark.parametrize(
    ("grid", "problems"),
    [
        ({}, ["selection.grid: is empty; name what to try, such as selection.grid: {hierarchy.levels.0.count: .*}"]),
        ({"task": ["needle"]}, ["selection.grid.task: candidates are compared on the same data; remove it"]),
        (
            {"demonstrations.count": [3], "training.epochs": [1]},
            ["selection.grid.demonstrations.count: candidates are compared on the same data; remove it"],
        ),
        (
            {"observations": [["place"], ["palce"], ["tern"]]},
            [r"selection.grid: observations=\['palce'\]: .*no palce.*", r"selection.grid: .*no tern.*"],
        ),
    ],
)
def test_what_is_refused_has_a_line_each(grid, problems):
    with pytest.raises(SpecError) as refused:
        candidates(with_grid(grid), SIZE)
    assert len(refused.value.problems) == len(problems)
    for found, expected in zip(refused.value.problems, problems, strict=True):
        assert re.fullmatch(expected, found)
