"""Trajectories side by side: unequal lengths, blocks that are not full, logits, and any number of threads."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import brute_force, random_tables

from ddco_pyro.inference import log_likelihood, logspace, posterior
from ddco_pyro.inference.kernel import LANES
from ddco_pyro.model.tables import NEVER, complete

SHAPES = [((1,), (True,)), ((3,), (False,)), ((2, 2), (True, False)), ((2, 1, 2), (True, True, True))]


def unequal(counts, hybrid, steps=3, seed=0):
    """Tables of so many trajectories that the last block is not full, and a length of each."""
    tables = random_tables(counts, hybrid, trajectories=LANES + 3, steps=steps, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    return tables, torch.randint(1, steps + 1, (LANES + 3,), generator=generator)


def as_logits(tables, seed=1):
    """The same tables, each selection and termination shifted by a number of its own."""
    generator = torch.Generator().manual_seed(seed)

    def shifted(table):
        return table + 50 * torch.randn(*table.shape[:-1], 1, generator=generator, dtype=torch.float64)

    selection, termination = (tuple(map(shifted, part)) for part in (tables.selection, tables.termination))
    return replace(tables, selection=selection, termination=termination, logits=True)


@pytest.mark.parametrize(("counts", "hybrid"), SHAPES)
@pytest.mark.parametrize("power", [1.0, 0.3])
def test_each_trajectory_of_a_block_has_the_sum_over_its_own_paths(counts, hybrid, power):
    tables, lengths = unequal(counts, hybrid)
    tables = replace(tables, power=power)
    for given in (tables, as_logits(tables)):
        found, values = posterior(given, lengths), log_likelihood(given, lengths)
        for n, length in enumerate(lengths.tolist()):
            truth = brute_force(tables, n, length)
            assert float(values[n]) == pytest.approx(truth.log_likelihood, abs=1e-9)
            for level, u in enumerate(truth.u):
                np.testing.assert_allclose(found.u[level][n, :length].numpy(), u, atol=1e-9)
                assert not found.u[level][n, length:].any()


@pytest.mark.parametrize(("counts", "hybrid"), SHAPES)
@pytest.mark.parametrize("impossible", [False, True])
def test_the_gradient_of_logits_is_that_of_the_recursion_in_logarithms(counts, hybrid, impossible):
    """Also where options are impossible, and where a mass underflows, so that log space takes over."""
    tables, lengths = unequal(counts, hybrid, steps=6, seed=2)
    if impossible:
        tables.selection[0][::2, :, :, -1] = NEVER
        tables.control[0][1, ::2, 0] = NEVER
        tables.termination[0][2, :, 0] = torch.tensor([0.0, NEVER], dtype=torch.float64)
        tables.control[0][3] *= 1e3
    evidence = tuple(torch.randn(*table.shape[:2], table.shape[-1]).double() for table in tables.selection)
    given = replace(as_logits(tables), evidence=evidence)
    leaves = [leaf.requires_grad_() for leaf in given.leaves()]
    value, truth = log_likelihood(given, lengths), logspace.log_likelihood(complete(given, lengths))
    torch.testing.assert_close(value, truth, rtol=1e-9, atol=1e-9)
    ours, theirs = (torch.autograd.grad(one[torch.isfinite(truth)].sum(), leaves) for one in (value, truth))
    for leaf, own, their in zip(leaves, ours, theirs, strict=True):
        entries = leaf > NEVER  # an impossible entry has no logarithm to differentiate by
        torch.testing.assert_close(own[entries], their[entries], rtol=1e-6, atol=1e-9)
