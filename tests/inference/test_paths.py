"""Most likely and sampled paths against sums over every path, and against Pyro's own answers on the same model."""

from __future__ import annotations

import itertools

import numpy as np
import pyro
import pytest
import torch
from oracle import paths, random_tables
from pyro.infer import TraceEnum_ELBO, infer_discrete

from ddco_pyro.inference import most_likely_path, posterior, sample_paths, segment
from ddco_pyro.inference.engines import known_controls
from ddco_pyro.model.ahmm import ahmm
from ddco_pyro.model.tables import NEVER, Tables, complete

CASES = [
    ((1,), (True,), 4),
    ((3,), (False,), 4),
    ((2, 2), (True, False), 3),
    ((2, 1), (False, True), 3),
    ((2, 1, 2), (True, True, True), 2),
    ((3,), (True,), 4),
    ((2, 2), (False, False), 3),
    ((2, 2), (True, True), 3),
    ((1, 2, 1), (False, True, False), 2),
    ((2, 1, 2), (False, False, False), 2),
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
    third = torch.tensor([1 / 3, 2 / 3]).double().log()  # keeping is as likely as ending and selecting the same again
    tables = Tables((selection,), (third.expand(1, 4, 2, 2),), (torch.zeros(1, 4, 2).double(), half * 0 + NEVER))
    assert as_tuples(most_likely_path(tables, torch.tensor([4])), 0, 4) == (((1,),) * 4, ((1,), (0,), (0,), (0,)))
    never_kept = Tables(tables.selection, (termination * 0 + torch.tensor([NEVER, 0.0]),), tables.control)
    assert as_tuples(most_likely_path(never_kept, torch.tensor([4])), 0, 4) == (((1,),) * 4, ((1,),) * 4)


@pytest.mark.parametrize(("counts", "hybrid"), [((3,), (True,)), ((2, 2), (False, True))])
def test_pyros_own_marginals_are_the_posterior(counts, hybrid):
    tables = random_tables(counts, hybrid, trajectories=2, steps=4, seed=14)
    lengths = torch.tensor([4, 3])
    elbo = TraceEnum_ELBO(max_plate_nesting=1, strict_enumeration_warning=False)
    marginals = elbo.compute_marginals(ahmm, lambda *_: None, complete(tables, lengths), *known_controls(tables))
    ours = posterior(tables, lengths)
    for t, d in itertools.product(range(4), range(len(counts))):
        alive = lengths > t
        theirs = marginals[f"h_{d + 1}_{t}"].logits.softmax(-1)  # what Pyro gives is not normalised
        torch.testing.assert_close(theirs[alive], ours.u[d][alive, t], atol=1e-9, rtol=0)
        if t > 0:
            ended = marginals[f"b_{d + 1}_{t}"].logits.softmax(-1)[..., 1]
            torch.testing.assert_close(ended[alive], ours.v[d][alive, t].sum(-1), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("counts", "hybrid"), [((3,), (True,)), ((2, 2), (False, True))])
def test_pyros_own_most_likely_path_is_ours(counts, hybrid):
    tables = random_tables(counts, hybrid, trajectories=2, steps=4, seed=15)
    lengths = torch.tensor([4, 4])
    inferred = infer_discrete(ahmm, first_available_dim=-2, temperature=0)
    sites = pyro.poutine.trace(inferred).get_trace(complete(tables, lengths), *known_controls(tables)).nodes
    found = most_likely_path(tables, lengths)
    for t, d in itertools.product(range(4), range(len(counts))):
        assert torch.equal(sites[f"h_{d + 1}_{t}"]["value"], found.choices[d][:, t])
        if t > 0:
            assert torch.equal(sites[f"b_{d + 1}_{t}"]["value"], found.terminations[d][:, t])


def test_a_flat_policy_has_no_path():
    tables = random_tables((), (), steps=3)
    assert most_likely_path(tables, torch.tensor([3])) == ((), ())
    np.testing.assert_equal(sample_paths(tables, torch.tensor([3]), 2).choices, ())
