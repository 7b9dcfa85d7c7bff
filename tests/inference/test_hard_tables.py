"""The compiled engine against the log-space recursion in float64, on tables made to break it."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import random_tables

from ddco_pyro.inference import log_likelihood, logspace, posterior
from ddco_pyro.model.tables import NEVER, Tables, complete

SHAPES = [(1,), (3,), (20,), (1, 1), (2, 2), (4, 1), (2, 1, 2)]


@pytest.mark.parametrize("counts", SHAPES)
def test_value_and_gradient_are_those_of_log_space(counts):
    compare(counts, steps=12, seed=2)


@pytest.mark.slow
@settings(max_examples=40)  # of 40 trajectories
@given(
    counts=st.sampled_from(SHAPES),
    steps=st.one_of(st.integers(1, 40), st.integers(1, 40), st.just(150)),
    seed=st.integers(0, 10_000),
)
def test_value_and_gradient_are_those_of_log_space_in_thousands_of_cases(counts, steps, seed):
    compare(counts, steps, seed)


def compare(counts, steps, seed):
    """Tiny σ, terminations within 1e-8 of 0 and 1 and at them, impossible options, options that are the same.

    Each trajectory has one combination of these, and its own share of impossible entries.
    """
    grid = list(product([1.0, 30.0, 1e3, 1e5], [0.0, 1e-8, 0.3, 1 - 1e-8, 1.0], [False, True]))
    sharp, termination, identical = (torch.tensor(column) for column in zip(*grid, strict=True))
    hybrid = tuple(bool(seed >> level & 1) for level in range(len(counts)))
    tables = random_tables(counts, hybrid, trajectories=len(grid), steps=steps, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    drawn = [torch.rand(len(grid), generator=generator) for _ in range(2)]
    impossible = 0.4 * drawn[0] * (drawn[1] < 0.8)

    def each(values, table):
        return values.reshape(-1, *[1] * (table.dim() - 1))

    def holes(table):
        drawn = torch.rand(table.shape, generator=generator)
        return torch.where(drawn < each(impossible, table), NEVER, table)

    control = tuple(holes(each(sharp, table) * table) for table in tables.control)
    same = each(identical, control[0])
    control = (torch.where(same, control[0][..., :1], control[0]), *control[1:])
    selection = tuple(holes(table) for table in tables.selection)
    ending = torch.stack([1 - termination.double(), termination.double()], -1).log()[:, None, None]
    somewhere = torch.rand(tables.termination[0][..., :1].shape, generator=generator) < 0.5
    lowest = torch.where(somewhere, ending, tables.termination[0])
    lengths = torch.randint(steps, (len(grid),), generator=generator) + 1
    agree(Tables(selection, (lowest, *tables.termination[1:]), control), lengths)


def agree(tables, lengths):
    """Values and gradients of every table, to 1e-6 relative; an impossible trajectory has -inf in both."""
    leaves = [table.requires_grad_() for table in tables.leaves()]
    value, truth = log_likelihood(tables, lengths), logspace.log_likelihood(complete(tables, lengths))
    torch.testing.assert_close(value, truth, rtol=1e-9, atol=1e-9)
    possible = torch.isfinite(truth)
    if possible.any():
        found = torch.autograd.grad(value[possible].sum(), leaves, allow_unused=True)
        expected = torch.autograd.grad(truth[possible].sum(), leaves, allow_unused=True)
        for ours, theirs, leaf in zip(found, expected, leaves, strict=True):
            theirs = torch.zeros_like(leaf) if theirs is None else theirs
            entries = leaf > NEVER  # an impossible entry has no logarithm to differentiate by
            torch.testing.assert_close(ours[entries], theirs[entries], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("counts", [(199,), (13, 13), (5, 5, 4)])
def test_two_hundred_joint_choices(counts):
    tables = random_tables(counts, (True,) * len(counts), trajectories=2, steps=12, seed=31)
    agree(tables, torch.tensor([12, 7]))


LONG = [pytest.param(10_000, sharp, marks=pytest.mark.slow) for sharp in (1.0, 100.0)]


@pytest.mark.parametrize(("steps", "sharp"), [(3000, 1.0), *LONG])
def test_thousands_of_steps(steps, sharp):
    tables, lengths = random_tables((5,), (True,), steps=steps, seed=8), torch.tensor([steps])
    agree(replace(tables, control=tuple(sharp * c for c in tables.control)), lengths)
    assert torch.allclose(posterior(tables, lengths).u[0].sum(-1), torch.ones(1, dtype=torch.float64))
