"""The links from networks' outputs to log-probabilities: compiled passes against the formulas that define them."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch
from oracle import random_tables
from scipy import special
from torch.nn.functional import log_softmax, one_hot, pad

from ddco_pyro.inference import logspace
from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.model.elementary import LANES, Plane, at, exponential, log_normal_cdf, logarithm, put, record
from ddco_pyro.model.emissions import Binary, Categorical, Clipped, Density, Gaussian, Hurdle, Product
from ddco_pyro.model.links import Link, LinkedTables, LogTable, Selection, Termination
from ddco_pyro.model.passes import TERMINATION_BOUND
from ddco_pyro.model.tables import NEVER, Tables, complete

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
    *(("selection", 0, Selection(normal(NUMBER, STEPS, CALLERS, 4 - control), control)) for control in (0, 1)),
    ("selection", 1, Selection(normal(STEPS, NUMBER, 1, 5).detach().transpose(0, 1).requires_grad_(), 0)),
    ("termination", 1, Termination(normal(NUMBER, STEPS, CALLERS))),
    ("termination", 1, Termination(normal(NUMBER, STEPS, CALLERS, scale=40.0))),
    ("control", 1, LogTable(normal(NUMBER, STEPS, CALLERS), log=True)),
    *(("control", 1, Density(emission, controls(emission))) for emission in EMISSIONS),
    ("control", 1, Density(categorical(False), torch.where(INDICES == 2, 7, INDICES).unsqueeze(-1))),  # 7: impossible
    ("control", 1, Density(categorical(True), ROWS.double())),
]


def with_link(group, place, link):
    """Tables of three options under four, of which one is a link; and the same with the formula's table."""
    given = random_tables((3, CALLERS), (True, True), trajectories=NUMBER, steps=STEPS, seed=5)
    parts = {name: list(getattr(given, name)) for name in ("selection", "termination", "control")}
    parts[group][place] = link
    formulas = ([part.formula() if isinstance(part, Link) else part for part in each] for each in parts.values())
    return LinkedTables(*parts.values()), Tables(*(tuple(each) for each in formulas))


@pytest.mark.parametrize("lengths", LENGTHS)
@pytest.mark.parametrize(("group", "place", "link"), CASES)
def test_compiled_passes_are_the_formula_and_its_gradient(group, place, link, lengths):
    """Of every trajectory, in the log-likelihood; what is past the trajectories has no gradient."""
    tables, formulas = with_link(group, place, link)
    wanted = [tensor for tensor in link.inputs if tensor.requires_grad]
    value, truth = log_likelihood(tables, lengths), logspace.log_likelihood(complete(formulas, lengths))
    torch.testing.assert_close(value, truth, rtol=1e-12, atol=1e-12)
    weight = normal(NUMBER).detach()
    found = torch.autograd.grad(value, wanted, weight, retain_graph=True)
    expected = torch.autograd.grad(truth, wanted, weight, allow_unused=True)
    again = torch.autograd.grad(value, wanted, weight)
    for own, theirs, repeated in zip(found, expected, again, strict=True):
        torch.testing.assert_close(own, theirs, rtol=1e-9, atol=1e-11)
        assert torch.equal(own, repeated)


def of_one_caller(tensor):
    own = tensor[..., :1, :] if tensor.dim() > 1 and tensor.shape[-2] == CALLERS else tensor
    return own.detach().requires_grad_(tensor.requires_grad)


@pytest.mark.parametrize("lengths", LENGTHS)
@pytest.mark.parametrize("link", [link for _, _, link in CASES if isinstance(link, Density)])
def test_a_policy_without_options_has_the_sum_of_its_densities(link, lengths):
    """And its gradient, where the control is possible."""
    alone = link.map(of_one_caller)
    wanted = [tensor for tensor in alone.inputs if tensor.requires_grad]
    alive = torch.arange(STEPS) < lengths.unsqueeze(-1)
    truth = torch.where(alive, alone.formula().squeeze(-1), 0.0).sum(1)
    value = log_likelihood(LinkedTables((), (), (alone,)), lengths)
    torch.testing.assert_close(value, truth, rtol=1e-12, atol=1e-12)
    possible = torch.isfinite(truth)
    pairs = [torch.autograd.grad(each[possible].sum(), wanted) for each in (value, truth)]
    for found, expected in zip(*pairs, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 300.0])
def test_switches_and_categories_are_those_of_torch(scale):
    """Log-likelihoods, and the gradients of logits, however large the logits are."""
    switches, choices = (normal(NUMBER, STEPS, CALLERS, size, scale=scale) for size in (2, 3))
    on = (normal(NUMBER, STEPS, 2).detach() > 0).double()
    bernoulli = torch.distributions.Bernoulli(logits=switches).log_prob(on.unsqueeze(2)).sum(-1)
    drawn = torch.distributions.Categorical(logits=choices).log_prob(INDICES.unsqueeze(-1))
    for emission, actions, logits, truth in (
        (Binary(switches), on, switches, bernoulli),
        (Categorical(choices, torch.tensor(False)), INDICES.unsqueeze(-1), choices, drawn),
    ):
        tables, _ = with_link("control", 1, Density(emission, actions))
        theirs, _ = with_link("control", 1, LogTable(truth, log=True))
        value, expected = log_likelihood(tables, LENGTHS[0]), log_likelihood(theirs, LENGTHS[0])
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
        found, slope = (torch.autograd.grad(each.sum(), logits, retain_graph=True) for each in (value, expected))
        torch.testing.assert_close(found, slope, rtol=1e-10, atol=1e-12)


def test_single_precision_loses_only_the_rounding_of_the_outputs():
    """However large the logits are, and however they stand in memory."""
    chosen, ended = (normal(NUMBER, STEPS, CALLERS, size, dtype=torch.float32, scale=30.0) for size in (4, 1))
    for group, link, exact in (
        ("selection", Selection(chosen, 0), Selection(chosen.double(), 0)),
        ("selection", Selection(chosen.mT.contiguous().mT, 0), Selection(chosen.double(), 0)),
        ("termination", Termination(ended.squeeze(3)), Termination(ended.squeeze(3).double())),
    ):
        place = 0 if group == "selection" else 1
        own, theirs = (with_link(group, place, each)[0] for each in (link, exact))
        torch.testing.assert_close(
            log_likelihood(own, LENGTHS[1]), log_likelihood(theirs, LENGTHS[1]), rtol=1e-13, atol=0
        )


@pytest.mark.parametrize("kind", ["selection", "termination"])
def test_what_is_not_a_number_stays_visible(kind):
    """In its own trajectory alone."""
    logits = normal(NUMBER, STEPS, CALLERS, 4).detach()
    logits[1, 2, 0, 1] = torch.nan
    link = Selection(logits, 0) if kind == "selection" else Termination(logits[..., 1])
    tables, _ = with_link(kind, 0 if kind == "selection" else 1, link)
    assert log_likelihood(tables, LENGTHS[0]).isfinite().tolist() == [True, False, True]


def test_formulas_are_those_of_the_model():
    logits = normal(2, 3, 1, 4)
    torch.testing.assert_close(Selection(logits, 1).table, pad(log_softmax(logits, -1), (1, 0), value=NEVER))
    probability = torch.sigmoid(TERMINATION_BOUND * torch.tanh(logits[:, :, 0] / TERMINATION_BOUND))
    expected = torch.stack([(1 - probability).log(), probability.log()], -1)
    torch.testing.assert_close(Termination(logits[:, :, 0]).table, expected)


def plane(address, index):
    """A plane of those at an address."""


record(plane, Plane)


@numba.njit
def apply(which, steps, planes):
    """Compute a function of the lanes in the first of two planes; results are [steps, 2]."""
    x, results = plane(planes, 0), plane(planes, 1)
    for t in range(steps):
        own = at(x, t, 0)
        if which == 0:
            first = second = exponential(own)
        elif which == 1:
            first = second = logarithm(own)
        else:
            first, second = log_normal_cdf(own)
        put(results, t, 0, first)
        put(results, t, 1, second)


def computed(which, x):
    """Values and derivatives at x [M]."""
    lots = -(-len(x) // LANES)
    padded, results = np.ones(lots * LANES), np.empty((lots, 2, LANES))
    padded[: len(x)] = x
    planes = np.array([padded.ctypes.data, 1, results.ctypes.data, 2])
    apply(which, lots, planes.ctypes.data)
    return results[:, 0].reshape(-1)[: len(x)], results[:, 1].reshape(-1)[: len(x)]


def test_elementary_functions_have_the_errors_that_they_state():
    x = np.concatenate([np.linspace(-50, 40, 20_001), -np.logspace(0, 12, 2001), np.logspace(-12, 3, 2001)])
    value, slope = computed(2, x)
    truth = special.log_ndtr(x)
    assert (np.abs(value - truth) / np.maximum(1, np.abs(truth))).max() < 2e-15
    low, high = x <= 0, (x > 0) & (x < 37)
    hazard = np.sqrt(2 / np.pi) / special.erfcx(-x[low] / np.sqrt(2))
    np.testing.assert_allclose(slope[low], hazard, rtol=2e-15)
    density = np.exp(-0.5 * x[high] ** 2) / np.sqrt(2 * np.pi) / special.ndtr(x[high])
    np.testing.assert_allclose(slope[high], density, rtol=4e-15)
    x = np.linspace(-708, 709, 20_001)
    np.testing.assert_allclose(computed(0, x)[0], np.exp(x), rtol=1e-15)
    np.testing.assert_array_equal(computed(0, np.array([-709.0, -np.inf, np.nan]))[0], [0.0, 0.0, np.nan])
    x = np.logspace(-300, 300, 20_001)
    value = computed(1, x)[0]
    assert (np.abs(value - np.log(x)) / np.maximum(1, np.abs(np.log(x)))).max() < 1e-15
