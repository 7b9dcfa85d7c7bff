"""Both engines, the posteriors and the segmentation against sums over every latent path."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from oracle import brute_force, random_tables

from ddco_pyro.inference import log_likelihood, posterior, segment
from ddco_pyro.inference.kernel import STEPS_A_THREAD, on_threads
from ddco_pyro.model.tables import NEVER, Tables

CASES = [
    ((), (), 5),
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
    np.testing.assert_allclose(float(log_likelihood(tables, lengths, engine).sum()), sum(truth), atol=1e-9, rtol=0)


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
def test_engines_have_the_same_gradient(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=3, steps=steps, seed=4)
    leaves = [leaf.detach().requires_grad_() for leaf in tables.leaves()]
    lengths, gradients = torch.tensor([steps, 1, max(steps - 1, 1)]), []
    for engine in ("fused", "enumerate"):
        total = log_likelihood(Tables.of(tables.depth, leaves), lengths, engine).sum()
        gradients.append(torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True))
    for leaf, ours, pyros in zip(leaves, *gradients, strict=True):
        possible = leaf > NEVER  # an impossible entry has no logarithm to differentiate by
        np.testing.assert_allclose(ours[possible], pyros[possible], atol=1e-10)


@pytest.mark.parametrize(("counts", "hybrid", "steps"), CASES[1:])
def test_segment_is_the_most_likely_path(counts, hybrid, steps):
    tables = random_tables(counts, hybrid, trajectories=2, steps=steps, seed=3)
    lengths = torch.tensor([steps, max(steps - 1, 1)])
    found = torch.stack(segment(tables, lengths), -1)
    for n, length in enumerate(lengths.tolist()):
        assert tuple(map(tuple, found[n, :length].tolist())) == brute_force(tables, n, length).best
        assert (found[n, length:] == -1).all()


def test_the_gradient_with_respect_to_the_tables_is_the_posterior():
    """Choices without a caller's choice 0 above them: the tables' own gradient is u, v and w of §4.1."""
    tables = random_tables((3,), (True,), trajectories=2, steps=4, seed=5)
    leaves = Tables(*(tuple(t.clone().requires_grad_() for t in level) for level in _parts(tables)))
    lengths = torch.tensor([4, 3])
    log_likelihood(leaves, lengths).sum().backward()
    for n, length in enumerate(lengths.tolist()):
        truth = brute_force(tables, n, length)
        np.testing.assert_allclose(leaves.selection[0].grad[n, :length, 0], truth.v[0], atol=1e-9)
        np.testing.assert_allclose(leaves.control[0].grad[n, :length], truth.u[0][:, 1:], atol=1e-9)
        ended = truth.u[0][:-1, 1:] - truth.w[0][:-1, 1:]
        np.testing.assert_allclose(leaves.termination[0].grad[n, 1:length, :, 0], truth.w[0][:-1, 1:], atol=1e-9)
        np.testing.assert_allclose(leaves.termination[0].grad[n, 1:length, :, 1], ended, atol=1e-9)


def test_second_derivatives_are_refused():
    tables = random_tables((2,), (False,), steps=3)
    leaf = tables.control[0].requires_grad_()
    value = log_likelihood(tables, torch.tensor([3])).square().sum()
    (gradient,) = torch.autograd.grad(value, leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="cannot differentiate again"):
        gradient.sum().backward()


def test_padding_changes_nothing():
    tables = random_tables((2, 2), (True, False), trajectories=2, steps=6, seed=6)
    lengths = torch.tensor([4, 3])
    short = Tables(*(tuple(t[:, :4] for t in level) for level in _parts(tables)))
    torch.testing.assert_close(log_likelihood(tables, lengths), log_likelihood(short, lengths), atol=0, rtol=0)


def test_permuting_options_changes_nothing():
    tables = random_tables((4,), (True,), trajectories=2, steps=6, seed=7)
    order = torch.tensor([2, 0, 3, 1])
    permuted = Tables(
        (tables.selection[0][..., torch.cat([torch.tensor([0]), order + 1])],),
        (tables.termination[0][:, :, order],),
        (tables.control[0][..., order], tables.control[1]),
    )
    lengths = torch.tensor([6, 5])
    torch.testing.assert_close(log_likelihood(tables, lengths), log_likelihood(permuted, lengths), atol=1e-12, rtol=0)
    found, again = posterior(tables, lengths).u[0], posterior(permuted, lengths).u[0]
    torch.testing.assert_close(found[..., 1 + order], again[..., 1:], atol=1e-12, rtol=0)


def _parts(tables):
    return tables.selection, tables.termination, tables.control


@pytest.mark.parametrize(("counts", "hybrid"), [((2,), (True,)), ((2, 1), (False, True))])
def test_threads_change_no_bit(counts, hybrid):
    tables = random_tables(counts, hybrid, trajectories=5, steps=STEPS_A_THREAD // 2, seed=3)
    lengths, found, parts = torch.tensor([STEPS_A_THREAD // 2, 1, 7, 1500, 2000]), [], []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            value, own = log_likelihood(tables, lengths), posterior(tables, lengths)
            found.append([value, *own.u, *own.v, *own.w, *segment(tables, lengths)])
            on_threads(lambda first, last: parts.append((first, last)), lengths.numpy())
        finally:
            torch.set_num_threads(1)
    assert sorted(parts) == [(0, 2), (0, 2), (0, 5), (2, 5), (2, 5)]  # 7604 steps are worth two threads
    for others in found[1:]:
        assert all(torch.equal(one, other) for one, other in zip(found[0], others, strict=True))
