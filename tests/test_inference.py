"""Both engines, the posteriors and the segmentation against sums over every latent path."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from oracle import brute_force, random_tables

from ddco_pyro.inference import log_likelihood, posterior, segment, total_log_likelihood

CASES = [
    ((1,), (False,), 5),
    ((1,), (True,), 5),
    ((3,), (False,), 4),
    ((3,), (True,), 4),
    ((2, 2), (False, False), 3),
    ((2, 2), (True, False), 3),
    ((2, 2), (False, True), 3),
    ((2, 2), (True, True), 3),
    ((1, 2, 1), (False, True, False), 2),
    ((2, 1, 2), (True, True, True), 2),
    ((2, 1, 2), (False, False, False), 2),
]


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
@pytest.mark.parametrize("engine", ["fused", "enumerate"])
def test_log_likelihood_is_the_sum_over_paths(counts, hybrid, steps, engine):
    tables = random_tables(counts, hybrid, trajectories=2, steps=steps, seed=1)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    truth = [brute_force(tables, n, int(length)).log_likelihood for n, length in enumerate(lengths)]
    np.testing.assert_allclose(log_likelihood(tables, lengths, engine).numpy(), truth, atol=1e-9, rtol=0)
    np.testing.assert_allclose(float(total_log_likelihood(tables, lengths, engine)), sum(truth), atol=1e-9, rtol=0)


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
def test_posterior_is_the_marginal_over_paths(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=2, steps=steps, seed=2)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    found = posterior(tables, lengths)
    for n, length in enumerate(lengths.tolist()):
        truth = brute_force(tables, n, length)
        for name, d in itertools.product("uvw", range(len(counts))):
            table = getattr(found, name)[d][n]
            np.testing.assert_allclose(table[:length].numpy(), getattr(truth, name)[d], atol=1e-9, err_msg=name)
            assert not table[length:].any()


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES)
def test_segment_is_the_most_likely_path(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=2, steps=steps, seed=3)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    found = torch.stack(segment(tables, lengths), -1)
    for n, length in enumerate(lengths.tolist()):
        assert tuple(map(tuple, found[n, :length].tolist())) == brute_force(tables, n, length).best
        assert (found[n, length:] == -1).all()
