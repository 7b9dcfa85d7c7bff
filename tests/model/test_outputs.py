"""What networks say: its tables, and the likelihood found without tables in between, value and gradient."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ddco_pyro.inference import log_likelihood, logspace
from ddco_pyro.model.emissions import Gaussian
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.model.tables import complete

LOG_SCALE = torch.tensor([0.1, 0.2], dtype=torch.float64)
EMITS = ["options", "both", "control"]


def random_outputs(counts, emits, number=2, steps=4, seed=0, sharp=1.0, dtype=torch.float64):
    """Random numbers from networks of levels with ``counts`` options and what each caller above the lowest emits."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return (sharp * torch.randn(*shape, generator=generator)).to(dtype).requires_grad_()

    number_of_callers, callers = [*counts, 1], []
    for level, k in enumerate([0, *counts]):
        both = [number, steps, number_of_callers[level]]
        said = emits[level - 1] if level else "control"
        logits = None if said == "control" else draw(*both, k + (said == "both"))
        std = (0.3 + torch.rand(2, generator=generator)).to(dtype).requires_grad_()
        emission = None if said == "options" else Gaussian(draw(*both, 2), std, LOG_SCALE)
        callers.append(CallerOutputs(k, logits, emission))
    return Outputs(tuple(callers), tuple(draw(number, steps, k) for k in counts))


def leaves(outputs):
    """What a gradient can be taken of."""
    tensors = []
    outputs.map(lambda tensor: tensors.append(tensor) or tensor)
    return [tensor for tensor in tensors if tensor.requires_grad]


def by_outputs(outputs, actions, lengths):
    return log_likelihood(outputs.tables(actions), lengths)


def random_actions(number=2, steps=4, seed=9, dtype=torch.float64):
    return torch.randn(number, steps, 2, generator=torch.Generator().manual_seed(seed)).to(dtype)


@settings(max_examples=60)
@given(st.data())
def test_the_compiled_pass_is_the_one_in_log_space(data):
    """Whatever is said, however sharply; underflow goes to log space."""
    counts = tuple(data.draw(st.lists(st.integers(1, 3), min_size=1, max_size=3)))
    emits = [data.draw(st.sampled_from(EMITS)) for _ in counts]
    steps, sharp = data.draw(st.integers(1, 6)), data.draw(st.sampled_from([0.1, 1.0, 10.0, 100.0]))
    outputs = random_outputs(counts, emits, 2, steps, data.draw(st.integers(0, 1000)), sharp)
    actions, lengths = random_actions(2, steps), torch.tensor([steps, data.draw(st.integers(1, steps))])
    weights = torch.tensor([1.0, -2.5], dtype=torch.float64)
    in_log_space = logspace.log_likelihood(complete(outputs.tables(actions), lengths))
    ways = by_outputs(outputs, actions, lengths), in_log_space
    torch.testing.assert_close(*ways, rtol=1e-9, atol=1e-9)
    found, expected = (
        torch.autograd.grad((way * weights).sum(), leaves(outputs), allow_unused=True, materialize_grads=True)
        for way in ways
    )
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6 * float(theirs.abs().max().clamp(min=1)))


def test_single_precision_stays_close():
    single = random_outputs((3, 2), ("both", "options"), 4, 50, dtype=torch.float32)
    actions, lengths = random_actions(4, 50, dtype=torch.float32), torch.full((4,), 50)
    double = single.map(torch.Tensor.double)
    found = by_outputs(single, actions, lengths)
    expected = by_outputs(double, actions.double(), lengths)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
    (gradient,) = torch.autograd.grad(found.sum(), single.emissions[0].mean)
    assert gradient.dtype == torch.float32


def test_a_second_derivative_is_never_left_out_in_silence():
    """A gradient penalty: a sum of something that has a second derivative and of the refused one."""
    outputs, actions, lengths = random_outputs((2,), ("options",)), random_actions(), torch.tensor([4, 4])
    value = by_outputs(outputs, actions, lengths).sum()
    ending = outputs.termination_logits[0]
    (gradient,) = torch.autograd.grad(value, ending, create_graph=True)
    with pytest.raises(RuntimeError, match="cannot differentiate again"):
        torch.autograd.grad(gradient.square().sum() + ending.square().sum(), ending)


def test_controls_that_want_a_gradient_get_it():
    """Through the tables: the gradient of a log-density with respect to the controls (a distribution's value)."""
    outputs, actions = random_outputs((2,), ("options",)), random_actions().requires_grad_()
    lengths = torch.tensor([4, 4])
    (found,) = torch.autograd.grad(by_outputs(outputs, actions, lengths).sum(), actions)
    tables = outputs.tables(actions)
    (expected,) = torch.autograd.grad(log_likelihood(tables, lengths, "enumerate").sum(), actions)
    torch.testing.assert_close(found, expected)
