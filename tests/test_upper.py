"""Levels above the lowest start from what follows what: EM against sums over every path, planted ones found."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import paths, random_tables
from planted import CONTROL, make_spec, make_truth, plant
from sklearn.metrics import normalized_mutual_info_score

from ddco_pyro.fitting import upper
from ddco_pyro.fitting.upper import Constants, drawn, fitted, improved
from ddco_pyro.inference import segment
from ddco_pyro.model.encoding import encode
from ddco_pyro.spec import SpecError, with_overrides

STEPS = 3


def random_constants(tables, seed=0):
    return Constants.drawn(tables, np.random.default_rng(seed))


# --- an iteration -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("counts", "hybrid"), [((2, 2), (False, False)), ((2, 3), (True, True)), ((2, 2, 2), (False,) * 3)]
)
def test_an_iteration_divides_counts_over_every_path(monkeypatch, counts, hybrid):
    """Selections and terminations counted on one path after another, each weighted by its probability."""
    monkeypatch.setattr(upper, "PSEUDO", 0.0)
    tables = random_tables(counts, hybrid, 2, STEPS)
    constants = random_constants(tables)
    constant, depth = constants.within(tables), len(counts)
    selected = [np.zeros(table.shape) for table in constants.selection]
    ended = [np.zeros((count, 2)) for count in counts[1:]]
    value = 0.0
    for n in range(2):
        every = list(paths(constant, n, STEPS, [1 + count for count in counts]))
        total = sum(probability for *_, probability in every)
        value += math.log(total)
        for h, b, probability in every:
            if probability:
                _count(h, b, probability / total, depth, selected, ended)
    found, after = improved([(tables, torch.tensor([STEPS, STEPS]))], constants)
    assert found == pytest.approx(value, abs=1e-9)
    for own, counted in zip(after.selection, selected, strict=True):
        np.testing.assert_allclose(own, counted / counted.sum(-1, keepdims=True), atol=1e-9)
    for own, counted in zip(after.termination, ended, strict=True):
        np.testing.assert_allclose(own, counted[:, 1] / counted.sum(-1), atol=1e-9)


def _count(h, b, weight, depth, selected, ended):
    """A path's selections, and the ends of levels whose lower neighbour ended too."""
    for t, level in itertools.product(range(STEPS), range(depth)):
        if b[t][level]:
            caller = h[t][level + 1] - 1 if level + 1 < depth else 0
            selected[level][caller, h[t][level] - 1] += weight
        if level > 0 and t > 0 and b[t][level - 1]:
            ended[level - 1][h[t - 1][level] - 1, b[t][level]] += weight


def test_no_iteration_lowers_the_likelihood(monkeypatch):
    monkeypatch.setattr(upper, "PSEUDO", 0.0)
    tables = random_tables((3, 2, 2), (False,) * 3, 5, 12, seed=3)
    pieces, constants, values = [(tables, torch.tensor([12, 7, 12, 1, 9]))], random_constants(tables), []
    for _ in range(25):
        value, constants = improved(pieces, constants)
        values.append(value)
    assert np.diff(values).min() > -1e-9
    assert values[-1] > values[0] + 0.01


def test_demonstrations_count_alike_in_one_piece_and_in_two():
    tables, lengths = random_tables((3, 2), (False, False), 4, 6), torch.tensor([6, 4, 6, 5])
    parts = [(_rows(tables, rows), lengths[rows]) for rows in (slice(0, 1), slice(1, 4))]
    constants = random_constants(tables)
    (whole, one), (pieces, other) = improved([(tables, lengths)], constants), improved(parts, constants)
    assert pieces == pytest.approx(whole, abs=1e-9)
    for expected, found in zip((*one.selection, *one.termination), (*other.selection, *other.termination), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)


def _rows(tables, rows):
    return replace(
        tables,
        **{name: tuple(t[rows] for t in getattr(tables, name)) for name in ("selection", "termination", "control")},
    )


# --- planted levels ---------------------------------------------------------------------------------------------------


def test_planted_levels_are_found_as_well_as_the_truth_finds_them(monkeypatch):
    """The truth's lowest level, everything above it from random starts; held out, beside the truth's own segments."""
    monkeypatch.setattr(upper, "STARTS", 8)
    truth = make_truth(make_spec((4, 4, 2), control=CONTROL), ending=0.0)
    demos, _ = plant(truth, 60, 60, seed=7)
    held_out, choices = plant(truth, 30, 60, seed=8)
    with torch.no_grad():
        (tables, lengths), (others, other_lengths) = (
            (truth.tabulate(batch), batch.lengths)
            for batch in (encode(part, truth.encoder, truth.scaling) for part in (demos, held_out))
        )
    constants = fitted([(tables, lengths)], seed=0)
    for level in (1, 2):
        agreements = [
            normalized_mutual_info_score(choices[..., level].flatten(), segment(said, other_lengths)[level].flatten())
            for said in (constants.within(others), others)
        ]
        assert agreements[0] > agreements[1] - 0.05, (level, agreements)


# --- drawn paths ------------------------------------------------------------------------------------------------------


def test_paths_are_drawn_of_every_level_above_the_lowest_and_keep_to_labels():
    tables, lengths = random_tables((2, 3, 2), (False,) * 3, 3, 5), torch.tensor([5, 2, 4])
    labels = torch.tensor([[1, -1, 3, -1, 3], [-1, 2, -1, -1, -1], [-1, -1, -1, -1, -1]])
    known = tables.clamp(2, labels)
    pieces = [
        (known.trajectory(0, 5), lengths[:1]),
        (known.trajectory(1, 2), lengths[1:2]),
        (known.trajectory(2, 4), lengths[2:]),
    ]
    found = drawn(pieces, random_constants(tables), seed=1, steps=5)
    assert list(found) == [2, 3]
    alive = torch.arange(5) < lengths[:, None]
    for choices, count in ((found[2], 3), (found[3], 2)):
        assert ((choices[alive] >= 1) & (choices[alive] <= count)).all()
        assert (choices[~alive] == -1).all()
    assert (found[2] == labels)[labels > 0].all()
    again = drawn(pieces, random_constants(tables), seed=1, steps=5)
    other = drawn(pieces, random_constants(tables), seed=2, steps=5)
    assert torch.equal(again[2], found[2])
    assert any(not torch.equal(other[level], found[level]) for level in found)


def test_equal_seeds_find_equal_constants():
    pieces = [(random_tables((2, 2), (False, False), 4, 8), torch.tensor([8, 8, 5, 3]))]
    one, two = (fitted(pieces, seed=4).selection for _ in range(2))
    assert all(torch.equal(*both) for both in zip(one, two, strict=True))


# --- the spec ---------------------------------------------------------------------------------------------------------


def test_segments_need_a_lowest_level_found_before():
    with pytest.raises(SpecError, match="training.upper_levels: segments are those of a lowest level found before"):
        make_spec((2, 2), upper_levels="segments", layerwise=False)


@pytest.mark.parametrize("place", ["hierarchy.levels.1.policy.emits", "hierarchy.meta_policy.emits"])
def test_segments_need_callers_that_select(place):
    spec = make_spec((2, 2), upper_levels="segments")
    assert with_overrides(spec, {place: ["options", "control"]}).training.upper_levels == "segments"
    with pytest.raises(SpecError, match=f"{place}: needs options") as caught:
        with_overrides(spec, {place: ["control"]})
    assert len(caught.value.problems) == 1
