"""The networks' tables, and the gradient of the likelihood against the paper's own gradient equation."""

import numpy as np
import pytest
import torch
from hierarchies import make_batch, make_hierarchy
from oracle import brute_force

from ddco_pyro.inference import log_likelihood
from ddco_pyro.inference.kernel import LANES
from ddco_pyro.model.batch import SIDE_BY_SIDE, Batch
from ddco_pyro.model.networks import Inputs


@pytest.mark.parametrize("emits", [("options",), ("options", "control")])
def test_gradient_is_the_papers_gradient_equation(emits):
    """∇L of §4.1 (and its hybrid terms, §4.2) with u, v, w summed over every path, against autograd."""
    hierarchy, batch = make_hierarchy((3,), emits).double(), make_batch()
    inputs = Inputs({"state": batch.inputs.vector.double()}, {}, batch.inputs.time)
    batch = Batch(inputs, batch.actions.double(), batch.lengths)
    parameters = list(hierarchy.parameters())
    tables = hierarchy.tabulate(batch)
    found = torch.autograd.grad(log_likelihood(tables, batch.lengths).sum(), parameters, retain_graph=True)
    surrogate = torch.zeros((), dtype=torch.float64)
    for n, length in enumerate(batch.lengths.tolist()):
        truth = brute_force(tables, n, length)
        u, v, w = (torch.from_numpy(part[0]) for part in (truth.u, truth.v, truth.w))
        eta, pi, psi = tables.selection[0][n, :length, 0], tables.control[0][n], tables.termination[0][n]
        surrogate = surrogate + (v[:, 1:] * eta[:, 1:]).sum() + (u[:, 1:] * pi[:length]).sum()
        surrogate = (
            surrogate
            + ((u - w)[:-1, 1:] * psi[1:length, :, 1]).sum()
            + (w[:-1, 1:] * psi[1:length, :, 0]).sum()
        )
        if "control" in emits:
            surrogate = surrogate + (v[:, 0] * (eta[:, 0] + tables.control[1][n, :length, 0])).sum()
    expected = torch.autograd.grad(surrogate, parameters)
    for ours, paper in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, paper, atol=1e-9, rtol=1e-7)


@pytest.mark.parametrize("counts", [(3,), (3, 2), (2, 3, 2)])
@pytest.mark.parametrize("emits", [("options",), ("options", "control"), ("control",)])
def test_tables_are_normalised(counts, emits):
    tables = make_hierarchy(counts, emits).tabulate(make_batch())
    for level, (selection, termination) in enumerate(zip(tables.selection, tables.termination, strict=True)):
        callers = counts[level + 1] if level + 1 < len(counts) else 1
        assert selection.shape == (2, 4, callers, 1 + counts[level])
        np.testing.assert_allclose(selection.exp().sum(-1).detach(), 1, rtol=1e-5)
        np.testing.assert_allclose(termination.exp().sum(-1).detach(), 1, rtol=1e-5)
        assert bool((selection[..., 0].exp() > 0).all()) == ("control" in emits)
        assert bool((selection[..., 1:].exp() > 0).all()) == ("options" in emits)
    assert tables.control[-1].isfinite().all() == ("control" in emits)


def test_discovery_sees_a_uniform_meta_policy():
    hierarchy, batch = make_hierarchy((3, 2)), make_batch()
    tables = hierarchy(batch.inputs, discovering=1).tables(batch.actions)
    assert tables.depth == 1
    np.testing.assert_allclose(tables.selection[0][..., 1:].exp(), 1 / 3, rtol=1e-6)
    assert (tables.selection[0][..., 0] == -torch.inf).all()


def test_a_learned_deviation_keeps_its_floor_and_is_shared_by_the_level():
    hierarchy = make_hierarchy((3,), std={"learn": True, "floor": 0.2})
    with torch.no_grad():
        hierarchy.levels[0].policy.std.raw[:] = -100.0
    np.testing.assert_allclose(hierarchy.levels[0].policy.std().detach(), [0.2, 0.2], rtol=1e-6)


def test_a_second_derivative_is_never_left_out_in_silence():
    batch = make_batch()
    outputs = make_hierarchy((2,))(batch.inputs)
    (ending,) = outputs.termination_logits
    value = log_likelihood(outputs.tables(batch.actions), batch.lengths).sum()
    with pytest.raises(RuntimeError, match="cannot differentiate again"):
        torch.autograd.grad(value, ending, create_graph=True)


def test_controls_that_want_a_gradient_get_it():
    """Through the tables: the gradient of a log-density with respect to controls (a distribution's value)."""
    batch = make_batch()
    tables = make_hierarchy((2,))(batch.inputs).tables(batch.actions.requires_grad_())
    values = (log_likelihood(tables, batch.lengths, engine).sum() for engine in ("fused", "enumerate"))
    found, expected = (torch.autograd.grad(own, batch.actions, retain_graph=True)[0] for own in values)
    assert found.abs().max() > 0.1
    torch.testing.assert_close(found, expected)


def test_pieces_of_a_batch_fill_the_lanes_of_the_pass():
    batch = make_batch(trajectories=20, steps=5)
    assert [len(piece) for _, piece in batch.pieces(5 * 12)] == [8, 8, 4]
    assert [len(piece) for _, piece in batch.pieces(5 * 6)] == [6, 6, 6, 2]
    assert SIDE_BY_SIDE == LANES
