"""The links from networks' outputs to log-probabilities: compiled passes against the formulas that define them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import special
from torch.nn.functional import log_softmax, one_hot, pad

from ddco_pyro.model.elementary import exponentials, log_normal_cdf, logarithms
from ddco_pyro.model.emissions import Binary, Categorical, Clipped, Density, Gaussian, Hurdle, Product
from ddco_pyro.model.links import TERMINATION_BOUND, Alive, LogTable, Posterior, Selection, Termination
from ddco_pyro.model.tables import NEVER

NUMBER, STEPS, CALLERS = 3, 7, 4
LENGTHS = [torch.tensor([7, 7, 7]), torch.tensor([7, 1, 4])]


def normal(*shape, dtype=torch.float64, scale=1.0):
    generator = torch.Generator().manual_seed(sum(shape))
    return (scale * torch.randn(*shape, generator=generator, dtype=torch.float64)).to(dtype).requires_grad_()


def positive(*shape):
    return normal(*shape).detach().abs().add(0.3).requires_grad_()


def clipped(std):
    low, high = torch.tensor([-1.0, -torch.inf], dtype=torch.float64), torch.tensor([0.5, 1.0], dtype=torch.float64)
    units = normal(2).detach()
    return Clipped(normal(NUMBER, STEPS, CALLERS, 2), std, units, low, high)


def gaussian(std):
    return Gaussian(normal(NUMBER, STEPS, CALLERS, 2), std, normal(2).detach())


def hurdle():
    return Hurdle(normal(NUMBER, STEPS, CALLERS, 1), clipped(positive(2)))


def binary():
    return Binary(normal(NUMBER, STEPS, CALLERS, 2))


STDS = [(2,), (CALLERS, 2), (NUMBER, STEPS, CALLERS, 2)]
EMISSIONS = [
    *(gaussian(positive(*shape)) for shape in STDS),
    *(clipped(positive(*shape)) for shape in STDS),
    hurdle(),
    Hurdle(normal(NUMBER, STEPS, CALLERS, 1), gaussian(positive(NUMBER, STEPS, CALLERS, 2))),
    binary(),
    Product((((1, 2), gaussian(positive(2))), ((0, 3), clipped(positive(CALLERS, 2))))),
    Product((((3, 0), binary()), ((2, 1), gaussian(positive(2))))),
]


def controls(emission):
    """Values within bounds and on them, switches' positions, and a hurdle's value."""
    values = normal(NUMBER, STEPS, emission.shape[-1]).detach()
    if isinstance(emission, Clipped | Hurdle):
        values = torch.minimum(values.clamp(min=-1.0), torch.tensor([0.5, 1.0]))
    if isinstance(emission, Hurdle):
        values[:, ::2] = 0.0
    if isinstance(emission, Product):
        values[..., [0, 3]] = (values[..., [0, 3]] > 0).double()
    if isinstance(emission, Binary):
        values = (values > 0).double()
        values[0, 0, 0] = 0.5  # impossible
    return values


def categorical(rows):
    return Categorical(normal(NUMBER, STEPS, CALLERS, 3), torch.tensor(rows))


INDICES = torch.arange(21).reshape(3, 7) % 4 % 3  # actions of three kinds
ROWS = one_hot(INDICES, 3)
ROWS[1, 0] = 1  # impossible


CASES = [
    *(Selection(normal(NUMBER, STEPS, CALLERS, 3), control) for control in (0, 1)),
    Selection(normal(STEPS, NUMBER, 1, 5).detach().transpose(0, 1).requires_grad_(), 0),
    Termination(normal(NUMBER, STEPS, CALLERS)),
    Termination(normal(NUMBER, STEPS, CALLERS, scale=40.0)),
    LogTable(normal(NUMBER, STEPS, CALLERS)),
    *(Density(emission, controls(emission)) for emission in EMISSIONS),
    Density(categorical(False), torch.where(INDICES == 2, 7, INDICES).unsqueeze(-1)),  # 7 is impossible
    Density(categorical(True), ROWS.double()),
]


@pytest.mark.parametrize("lengths", LENGTHS)
@pytest.mark.parametrize("link", CASES)
def test_compiled_passes_are_the_formula_and_its_gradient(link, lengths):
    """In columns 2 to 2 + n of rows of n + 3; what is past the trajectories has no gradient."""
    alive, columns = Alive.of(lengths, STEPS), slice(2, 2 + link.columns)
    rows = np.full((len(alive.rows), link.columns + 3), np.nan)
    kept = link.fill(alive, rows, 2)
    table, steps = link.formula(), torch.arange(STEPS) < lengths[:, None]
    logs = isinstance(link, Density)
    expected = (table if logs else table.exp())[steps].flatten(1).detach()
    torch.testing.assert_close(torch.from_numpy(rows[:, columns]), expected, rtol=1e-12, atol=1e-12)
    posterior, weight = normal(*rows.shape).detach().numpy(), normal(len(rows)).detach().numpy()
    posterior[:, columns] *= (table[steps] > NEVER).flatten(1).numpy()  # as the elimination gives it
    found = link.gradients(alive, Posterior(rows, posterior, weight), 2, kept)
    upstream = torch.from_numpy(posterior[:, columns] * weight[:, None]).reshape(-1, *link.shape[2:])
    wanted = [tensor for tensor in link.inputs if tensor.requires_grad]
    truth = torch.autograd.grad(table[steps], wanted, upstream, allow_unused=True)
    ours = [own for own, tensor in zip(found, link.inputs, strict=True) if tensor.requires_grad]
    for own, theirs in zip(ours, truth, strict=True):
        torch.testing.assert_close(own, theirs, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("scale", [1.0, 300.0])
def test_switches_and_categories_are_those_of_torch(scale):
    """Log-probabilities and the gradients of logits, however large the logits are."""
    alive = Alive.of(LENGTHS[0], STEPS)
    upstream, weight = normal(21, CALLERS).detach(), normal(21).detach()
    switches, choices = (normal(NUMBER, STEPS, CALLERS, size, scale=scale) for size in (2, 3))
    on = (normal(NUMBER, STEPS, 2).detach() > 0).double()
    bernoulli = torch.distributions.Bernoulli(logits=switches).log_prob(on.unsqueeze(2)).sum(-1)
    drawn = torch.distributions.Categorical(logits=choices).log_prob(INDICES.unsqueeze(-1))
    for emission, actions, logits, truth in (
        (Binary(switches), on, switches, bernoulli),
        (Categorical(choices, torch.tensor(False)), INDICES.unsqueeze(-1), choices, drawn),
    ):
        link, rows = Density(emission, actions), np.empty((21, CALLERS))
        kept = link.fill(alive, rows, 0)
        expected = truth.detach().flatten(0, 1).numpy()
        np.testing.assert_allclose(rows, expected, rtol=1e-12, atol=1e-12)
        (found,) = link.gradients(alive, Posterior(rows, upstream.numpy(), weight.numpy()), 0, kept)
        (slope,) = torch.autograd.grad(truth, logits, (upstream * weight[:, None]).reshape(truth.shape))
        torch.testing.assert_close(found, slope, rtol=1e-10, atol=1e-12)


def test_single_precision_loses_only_the_rounding_of_the_outputs():
    """However large the logits are."""
    lengths = LENGTHS[0]
    alive = Alive.of(lengths, STEPS)
    single = normal(NUMBER, STEPS, 1, 6, dtype=torch.float32, scale=30.0)
    for link, exact in (
        (Selection(single, 1), Selection(single.double(), 1)),
        (Termination(single.squeeze(2)), Termination(single.squeeze(2).double())),
    ):
        rows = [np.empty((len(alive.rows), link.columns)) for _ in range(2)]
        for one, own in zip((link, exact), rows, strict=True):
            one.fill(alive, own, 0)
        np.testing.assert_allclose(*rows, rtol=1e-12)


def test_what_is_not_a_number_stays_visible():
    logits = torch.tensor([0.0, torch.nan, 1.0]).reshape(1, 1, 1, 3)
    alive, chosen, ended = Alive.of(torch.tensor([1]), 1), np.empty((1, 3)), np.empty((1, 6))
    Selection(logits, 0).fill(alive, chosen, 0)
    Termination(logits[0]).fill(alive, ended, 0)
    assert np.isnan(chosen).all()
    assert np.isnan(ended).tolist() == [[False, False, True, True, False, False]]


def test_formulas_are_those_of_the_model():
    logits = normal(2, 3, 1, 4)
    torch.testing.assert_close(Selection(logits, 1).table, pad(log_softmax(logits, -1), (1, 0), value=NEVER))
    probability = torch.sigmoid(TERMINATION_BOUND * torch.tanh(logits[:, :, 0] / TERMINATION_BOUND))
    expected = torch.stack([(1 - probability).log(), probability.log()], -1)
    torch.testing.assert_close(Termination(logits[:, :, 0]).table, expected)


def test_elementary_functions_have_the_errors_that_they_state():
    x = np.concatenate([np.linspace(-50, 40, 20_001), -np.logspace(0, 12, 2001), np.logspace(-12, 3, 2001)])
    value, slope = x.copy(), np.empty_like(x)
    log_normal_cdf(value, slope)
    truth = special.log_ndtr(x)
    assert (np.abs(value - truth) / np.maximum(1, np.abs(truth))).max() < 2e-15
    low, high = x <= 0, (x > 0) & (x < 37)
    hazard = np.sqrt(2 / np.pi) / special.erfcx(-x[low] / np.sqrt(2))
    np.testing.assert_allclose(slope[low], hazard, rtol=2e-15)
    density = np.exp(-0.5 * x[high] ** 2) / np.sqrt(2 * np.pi) / special.ndtr(x[high])
    np.testing.assert_allclose(slope[high], density, rtol=4e-15)
    x = np.linspace(-708, 709, 20_001)
    value = x.copy()
    exponentials(value)
    np.testing.assert_allclose(value, np.exp(x), rtol=1e-15)
    special_values = np.array([-709.0, -np.inf, np.nan])
    exponentials(special_values)
    np.testing.assert_array_equal(special_values, [0.0, 0.0, np.nan])
    x = np.logspace(-300, 300, 20_001)
    value = x.copy()
    logarithms(value)
    assert (np.abs(value - np.log(x)) / np.maximum(1, np.abs(np.log(x)))).max() < 1e-15
