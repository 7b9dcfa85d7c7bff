"""The compiled links from what networks say to log-probabilities: value, gradient and second derivative."""

from __future__ import annotations

import math

import pytest
import torch
from torch.nn.functional import log_softmax, pad

from ddco_pyro.model.links import TERMINATION_BOUND, log_selection, log_termination, weighted_squares
from ddco_pyro.model.tables import NEVER


def normal(*shape, dtype=torch.float64, scale=1.0):
    generator = torch.Generator().manual_seed(sum(shape))
    return (scale * torch.randn(*shape, generator=generator, dtype=torch.float64)).to(dtype).requires_grad_()


def selection(logits):
    return log_selection(logits, 0)


def hybrid_selection(logits):
    return log_selection(logits, 1)[..., 1:]


def normal_log_density(mean, std, actions):
    return torch.distributions.Normal(mean, std).log_prob(actions.unsqueeze(-2)).sum(-1)


def squares_as_log_density(mean, std, actions):
    constant = (std.log() + 0.5 * math.log(2 * math.pi)).expand(mean.shape).sum(-1)
    return weighted_squares(mean, -0.5 / std.square(), actions) - constant


def terminations(logits):
    probability = torch.sigmoid(TERMINATION_BOUND * torch.tanh(logits / TERMINATION_BOUND))
    return torch.stack([(1 - probability).log(), probability.log()], -1)


CASES = [
    (selection, lambda logits: log_softmax(logits, -1), [(2, 3, 4, 5)]),
    (hybrid_selection, lambda logits: log_softmax(logits, -1), [(2, 3, 1, 4)]),
    (log_termination, terminations, [(2, 3, 4)]),
    (squares_as_log_density, normal_log_density, [(2, 3, 4, 2), (2,), (2, 3, 2)]),
    (squares_as_log_density, normal_log_density, [(2, 3, 4, 2), (4, 2), (2, 3, 2)]),
    (squares_as_log_density, normal_log_density, [(2, 3, 4, 2), (2, 3, 4, 2), (2, 3, 2)]),
]


@pytest.mark.parametrize(("link", "truth", "shapes"), CASES)
@pytest.mark.parametrize("strided", [False, True])
def test_value_and_gradients_are_those_of_torch(link, truth, shapes, strided):
    inputs = [normal(*shape) for shape in shapes]
    if len(inputs) > 1:
        inputs[1] = inputs[1].detach().abs().add(0.3).requires_grad_()
    if strided:
        inputs[0] = inputs[0].detach().transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
    value, expected = link(*inputs), truth(*inputs)
    torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
    upstream = normal(*value.shape).detach()
    for leaves in (inputs[:1], inputs[:2], inputs):  # the controls' gradient goes another way
        found = torch.autograd.grad((value * upstream).sum(), leaves, retain_graph=True)
        theirs = torch.autograd.grad((expected * upstream).sum(), leaves, retain_graph=True)
        torch.testing.assert_close(found, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("link", "shape"), [(selection, (2, 3)), (log_termination, (2, 3))])
def test_second_derivatives_are_those_of_torch(link, shape):
    assert torch.autograd.gradgradcheck(link, normal(*shape))


def test_the_second_derivative_of_squares_is_that_of_torch():
    inputs = normal(2, 3, 2), normal(2), normal(2, 2)
    assert torch.autograd.gradgradcheck(weighted_squares, inputs)


def test_a_choice_that_is_not_there_is_impossible():
    found = log_selection(normal(2, 3, 1, 4), 1)
    torch.testing.assert_close(found, pad(log_softmax(normal(2, 3, 1, 4), -1), (1, 0), value=NEVER))


@pytest.mark.parametrize("link", [selection, hybrid_selection, log_termination])
def test_single_precision_keeps_what_it_can(link):
    """However large the logits are; rounding of the logits themselves left out."""
    single = normal(20, 6, dtype=torch.float32, scale=30.0)
    torch.testing.assert_close(link(single).double(), link(single.double()), rtol=3e-6, atol=1e-12)


def test_what_is_not_a_number_stays_visible():
    logits = torch.tensor([[0.0, torch.nan, 1.0]])
    assert selection(logits).isnan().all()
    assert log_termination(logits)[:, 1].isnan().all()
