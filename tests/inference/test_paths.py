"""Most likely and sampled paths against sums over every path, and Pyro's own answers on the same model."""

import numpy as np
import pytest
import torch
from oracle import paths, random_tables

from ddco_pyro.inference import most_likely_path, sample_paths, segment
from ddco_pyro.model.tables import NEVER, Tables

CASES = [
    ((1,), (True,), 4),
    ((3,), (False,), 4),
    ((2, 2), (True, False), 3),
    ((2, 1), (False, True), 3),
    ((2, 1, 2), (True, True, True), 2),
    ((2, 2), (True, True), 3),
    ((1, 2, 1), (False, True, False), 2),
]


def as_tuples(path, n, length, sample=None):
    """[T] of (choices, terminations), each with a number for every level."""
    pick = (lambda table: table[n, :length]) if sample is None else (lambda table: table[sample, n, :length])
    choices = torch.stack([pick(level) for level in path.choices], -1).tolist()
    ends = torch.stack([pick(level) for level in path.terminations], -1).tolist()
    return tuple(map(tuple, choices)), tuple(map(tuple, ends))


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
def test_the_most_likely_path_has_the_largest_probability(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=3, steps=steps, seed=11)
    lengths = torch.tensor([steps, 1, steps - 1])
    found = most_likely_path(tables, lengths)
    for n, length in enumerate(lengths.tolist()):
        every = paths(tables, n, length, [table.shape[-1] for table in tables.selection])
        best = max(every, key=lambda one: one[2])
        assert as_tuples(found, n, length) == best[:2]
        assert all((level[n, length:] == -1).all() for level in (*found.choices, *found.terminations))
    assert all(map(torch.equal, segment(tables, lengths), found.choices))


def test_of_equally_likely_paths_the_one_that_keeps_the_lowest_choices():
    """Two options that are the same in everything, at every step."""
    half = torch.full((1, 4, 1), 0.5).double().log()
    selection = torch.cat([torch.full((1, 4, 1, 1), NEVER), half.unsqueeze(-1), half.unsqueeze(-1)], -1)
    termination = torch.full((1, 4, 2, 2), 0.5).double().log()
    # keeping is as likely as ending and selecting the same again
    third = torch.tensor([1 / 3, 2 / 3]).double().log().expand(1, 4, 2, 2)
    tables = Tables((selection,), (third,), (torch.zeros(1, 4, 2).double(), half * 0 + NEVER))
    path = as_tuples(most_likely_path(tables, torch.tensor([4])), 0, 4)
    assert path == (((1,),) * 4, ((1,), (0,), (0,), (0,)))
    never_kept = Tables(tables.selection, (termination * 0 + torch.tensor([NEVER, 0.0]),), tables.control)
    assert as_tuples(most_likely_path(never_kept, torch.tensor([4])), 0, 4) == (((1,),) * 4, ((1,),) * 4)


def test_a_flat_policy_has_no_path():
    tables = random_tables((), (), steps=3)
    assert most_likely_path(tables, torch.tensor([3])) == ((), ())
    np.testing.assert_equal(sample_paths(tables, torch.tensor([3]), 2).choices, ())
