"""Kinds of control against scipy, torch and brute force, and the Pyro program with given controls."""

import itertools

import numpy as np
import pyro
import pytest
import torch
from hierarchies import make_batch, make_hierarchy
from oracle import brute_force
from scipy import special, stats

from ddco_pyro.inference import log_likelihood
from ddco_pyro.inference.engines import compare_engines
from ddco_pyro.model.ahmm import ahmm
from ddco_pyro.model.emissions import Product
from ddco_pyro.model.emissions.binary import Binary
from ddco_pyro.model.emissions.categorical import Categorical
from ddco_pyro.model.emissions.clipped import Clipped, LogNormal
from ddco_pyro.model.emissions.gaussian import Gaussian
from ddco_pyro.model.emissions.hurdle import Hurdle
from ddco_pyro.model.emissions.student import Student, student_control
from ddco_pyro.model.outputs import CallerOutputs, Outputs
from ddco_pyro.model.tables import complete

DRAWS = 600


def test_a_control_can_be_conditioned_on():
    """With each control given the program has the tables' likelihood; with one changed, the changed one's."""
    batch = make_batch()
    with torch.no_grad():
        outputs = make_hierarchy((2,))(batch.inputs)
    chain, actions = complete(outputs.tables(), batch.lengths), batch.actions.clone()
    actions[:, 1] += 0.5
    given = {f"a_{t}": control for t, control in enumerate(actions.unbind(1))}
    elbo = pyro.infer.TraceEnum_ELBO(max_plate_nesting=1, strict_enumeration_warning=False)
    conditioned = pyro.condition(ahmm, data=given)
    value = -elbo.loss(conditioned, lambda *_: None, chain, outputs.emissions)
    expected = log_likelihood(outputs.tables(actions), batch.lengths).sum()
    assert value == pytest.approx(float(expected), rel=1e-5)


# --- kinds --------------------------------------------------------------------------------------------------

STD = torch.tensor([0.4, 1.3], dtype=torch.float64)
SCALE = torch.tensor([2.0, 0.5], dtype=torch.float64)
INF = float("inf")
LOW, HIGH = torch.tensor([-1.0, -INF]), torch.tensor([1.0, 0.5])


def numbers(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def clipped(mean, std=STD):
    return Clipped(mean, std, SCALE.log(), LOW, HIGH)


@pytest.mark.parametrize("std", [STD, torch.stack([STD, 2 * STD, 0.5 * STD])], ids=["shared", "own"])
def test_a_clipped_density_is_scipys(std):
    mean = numbers(5, 3, 2)
    actions = torch.tensor([[-1.0, 0.5], [1.0, 0.1], [0.2, 0.5], [0.3, -3.0], [1.0, 0.5]]).double()
    found = clipped(mean, std).by_dimension(actions)
    for n, k, d in itertools.product(range(5), range(3), range(2)):
        a, m, s = float(actions[n, d]), float(mean[n, k, d]), float(std.expand(3, 2)[k, d])
        if a <= float(LOW[d]):
            expected = stats.norm.logcdf((a - m) / s)
        elif a >= float(HIGH[d]):
            expected = stats.norm.logsf((a - m) / s)
        else:
            expected = stats.norm.logpdf(a * float(SCALE[d]), m * float(SCALE[d]), s * float(SCALE[d]))
        assert float(found[n, k, d]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("far", [0.0, 1.0, 1e2, 1e4, 1e8, 1e12])
@pytest.mark.parametrize("std", [1.0, 0.01, 1e-6])
@pytest.mark.parametrize("of_each_step", [False, True])
def test_far_from_a_bound_value_and_gradient_stay_finite(far, std, of_each_step):
    mean = torch.full((1, 1, 1), -far, dtype=torch.float64).requires_grad_()
    shape = (1, 1, 1) if of_each_step else (1,)
    deviation = torch.full(shape, std, dtype=torch.float64).requires_grad_()
    zero = torch.zeros(1)
    emission = Clipped(mean, deviation, zero, torch.tensor([-INF]), torch.tensor([1.0]))
    value = emission.log_density(torch.ones(1, 1)).sum()
    gradients = torch.autograd.grad(value, [mean, deviation])
    assert torch.isfinite(value)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    z = (1.0 + far) / std  # the derivative of log Φ(-z) tends to z
    if z > 100:
        assert float(gradients[0]) == pytest.approx(z / std, rel=2e-4)


def hurdle(logit, mean, std=STD):
    return Hurdle(logit, clipped(mean, std))


def test_a_hurdle_is_its_value_and_scipys_normal():
    """One probability for all dimensions; a control with one dimension alone at its value is continuous."""
    logit, mean = numbers(4, 2, 1), numbers(4, 2, 2, seed=1)
    emission = Hurdle(logit, Gaussian(mean, STD, SCALE.log()))
    actions = torch.tensor([[0.0, 0.0], [0.0, 0.3], [1e-30, 0.0], [-0.0, 0.0]], dtype=torch.float64)
    found = emission.log_density(actions)
    for n, k in itertools.product(range(4), range(2)):
        expected = -np.log1p(np.exp(-float(logit[n, k])))
        if n in (1, 2):
            at, centre, spread = (tensor.numpy() * SCALE.numpy() for tensor in (actions[n], mean[n, k], STD))
            expected = -np.log1p(np.exp(float(logit[n, k]))) + stats.norm.logpdf(at, centre, spread).sum()
        assert float(found[n, k]) == pytest.approx(expected, rel=1e-12)
    assert torch.equal(emission.mode, torch.where(logit >= 0, 0.0, mean))


def test_a_hurdles_divergence_is_the_mean_of_log_ratios():
    """By draws of both callers, σ differing: within five standard errors."""
    logit, mean = torch.tensor([[-1.0], [0.7]], dtype=torch.float64), numbers(2, 2)
    emission = Hurdle(logit, Gaussian(mean, torch.stack([STD, 1.5 * STD]), SCALE.log()))
    torch.manual_seed(0)
    drawn = emission.draw(torch.randn(50_000, emission.noise, dtype=torch.float64))
    total, variance = 0.0, 0.0
    for i in range(2):
        scores = emission.log_density(drawn[:, i])
        ratio = scores[:, i] - scores[:, 1 - i]
        total, variance = total + 0.5 * float(ratio.mean()), variance + 0.25 * float(ratio.var()) / len(ratio)
    assert float(emission.divergence(0)[1]) == pytest.approx(total, abs=5 * variance**0.5)


MEAN, AT, OWN = numbers(2, 3, 2, 2), numbers(2, 3, 2, 1, seed=2), torch.stack([STD, 2 * STD])
SWITCH = numbers(2, 3, 2, 1, seed=1)
KINDS = {
    "gaussian": lambda: Gaussian(MEAN, STD, SCALE.log()),
    "gaussian, own σ": lambda: Gaussian(MEAN, OWN, SCALE.log()),
    "clipped": lambda: clipped(MEAN),
    "gaussian, σ of each step": lambda: Gaussian(MEAN, std_of_steps(), SCALE.log()),
    "clipped, σ of each step": lambda: clipped(MEAN, std_of_steps()),
    "student": lambda: student(STD),
    "student, own σ": lambda: student(OWN),
    "student beside": lambda: Product((((2, 0), student(STD)), ((1,), Binary(SWITCH)))),
    "binary": lambda: Binary(MEAN),
    "categorical": lambda: Categorical(numbers(2, 3, 2, 4)),
    "hurdle": lambda: Hurdle(AT, Gaussian(MEAN, STD, SCALE.log())),
    "hurdle, clipped, own σ": lambda: hurdle(AT, MEAN, OWN),
    "hurdles": lambda: Product((((1,), one_hurdle(5)), ((0,), one_hurdle(6)))),
    "product": lambda: Product((((2, 0), clipped(MEAN)), ((1,), Binary(SWITCH)))),
}


def student(std):
    return Student(numbers(2, 3, 2, 2), std, SCALE.log())


def std_of_steps():
    return 0.3 + numbers(2, 3, 2, 2, seed=7).abs()


def one_hurdle(seed):
    return Hurdle(numbers(2, 3, 2, 1, seed=seed), Gaussian(numbers(2, 3, 2, 1), STD[:1], SCALE[:1].log()))


def actions_of(kind):
    """Controls [2, 3, A] that the kind can emit, some of them on bounds."""
    generator = torch.Generator().manual_seed(3)
    switches = torch.randint(0, 2, (2, 3, 2), generator=generator).double()
    reals = numbers(2, 3, 2, seed=4).clamp(LOW, HIGH)
    index = torch.randint(0, 4, (2, 3), generator=generator)
    resting = torch.tensor([[[1, 1], [0, 0], [1, 0]], [[1, 1], [0, 1], [0, 0]]])
    if "hurdle" in kind:
        return torch.where(resting == 1, 0.0, reals)
    return {
        "binary": switches,
        "categorical": index.unsqueeze(-1).double(),
        "student beside": torch.stack([reals[..., 1], switches[..., 0], reals[..., 0]], dim=-1),
        "product": torch.stack([reals[..., 1], switches[..., 0], reals[..., 0]], dim=-1),
    }.get(kind, reals if "clipped" in kind else numbers(2, 3, 2, seed=4))


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_finite_differences(kind):
    emission, actions, leaves = KINDS[kind](), actions_of(kind), []

    def learned(tensor):
        return tensor.dtype == torch.float64 and torch.isfinite(tensor).all()

    def kept(tensor):
        leaves.extend([tensor.clone().requires_grad_()] * bool(learned(tensor)))
        return tensor

    def density(*values):
        given = iter(values)
        return emission.map(lambda tensor: next(given) if learned(tensor) else tensor).log_density(actions)

    emission.map(kept)
    assert torch.autograd.gradcheck(density, leaves)
    torch.testing.assert_close(emission.by_dimension(actions).sum(-1), emission.log_density(actions))


@pytest.mark.parametrize("kind", ["student", "student, own σ"])
def test_a_student_is_that_of_scipy(kind):
    emission, actions = KINDS[kind](), actions_of(kind)
    scales = emission.std.expand(2, 2) * SCALE
    found = emission.log_density(actions)
    for n, t, k in itertools.product(range(2), range(3), range(2)):
        truth = stats.multivariate_t(emission.mean[n, t, k] * SCALE, np.diag(scales[k] ** 2), df=4)
        assert float(found[n, t, k]) == pytest.approx(truth.logpdf(actions[n, t] * SCALE), abs=1e-12)


def test_draws_of_a_student_have_its_radius_and_its_controller():
    """(a - μ)² / σ² over A dimensions is A times an F variate; the export's numpy draws the same."""
    emission = Student(numbers(1, 2), STD, SCALE.log())
    noise = torch.randn(4000, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn = emission.draw(noise)[:, 0]
    radius = ((drawn - emission.mean) / STD).square().sum(-1) / 2
    assert stats.kstest(radius, stats.f(2, 4).cdf).pvalue > 0.01
    part = {"scale": [1.0, 1.0], "shift": [0.0, 0.0], "ends": [[], []]}
    for own, z in zip(drawn[:200], noise.numpy(), strict=False):
        found = student_control(part, emission.mean[0].numpy(), STD.numpy(), z)
        np.testing.assert_allclose(found, own, rtol=1e-10)


def test_the_divergence_of_students_is_at_least_that_of_draws():
    emission = student(torch.stack([STD, 2 * STD]))
    noise = torch.randn(4000, 2, 3, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    total = 0.0
    for i in range(2):
        drawn = torch.stack([emission.draw(one)[..., i, :] for one in noise])
        scores = torch.stack([emission.log_density(one) for one in drawn])
        total = total + 0.5 * (scores[..., i] - scores[..., 1 - i]).mean(0)
    bound = emission.divergence(0)[..., 1]
    assert (bound > total - 0.05).all()
    same = Student(torch.zeros(2, 2), STD, SCALE.log())
    assert float(same.divergence(0)[..., 1]) == 0


@pytest.mark.parametrize(("dtype", "precision"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_log_of_the_normal_distribution_function(dtype, precision):
    far = torch.tensor([-1e9, -1e4, -30.0, 0.0, 40.0])
    values = torch.cat([torch.linspace(-60, 12, 2001), far]).to(dtype)
    found = LogNormal.apply(values.requires_grad_())
    (slope,) = torch.autograd.grad(found.sum(), values)
    x = values.detach().double().numpy()
    truth = special.log_ndtr(x)
    np.testing.assert_allclose(found.detach(), truth, rtol=precision, atol=0.1 * precision)
    near = np.abs(x) < 1e3
    ratio = np.exp(stats.norm.logpdf(x[near]) - truth[near])
    np.testing.assert_allclose(slope[near], ratio, rtol=max(precision, 1e-8) * 20, atol=precision)
    np.testing.assert_allclose(slope[~near], -x[~near], rtol=1e-7)  # φ / Φ goes to -x


@pytest.mark.parametrize("kind", ["binary", "categorical"])
def test_probabilities_sum_to_one_and_other_values_have_none(kind):
    emission = KINDS[kind]()
    size = emission.shape[-1]
    every = {
        "binary": torch.cartesian_prod(torch.arange(2.0), torch.arange(2.0)),
        "categorical": torch.arange(4.0).unsqueeze(1),
    }[kind].double()
    each = torch.stack([emission.log_density(action.expand(2, 3, size)).exp() for action in every])
    torch.testing.assert_close(each.sum(0), torch.ones_like(each[0]))
    for k in range(2):
        found = emission.log_density(emission.mode[..., k, :])[..., k].exp()
        assert torch.equal(found, each.max(0)[0][..., k])
    for value in (0.5, -1.0, 7.0):
        other = torch.full((2, 3, size), value)
        assert (emission.log_density(other.double()) == -INF).all()


@pytest.mark.parametrize("kind", KINDS)
def test_draws_have_the_density_and_stay_possible(kind):
    """∫ p q / (p + q) of two callers, from draws of either: within five standard errors."""
    emission, shares = KINDS[kind](), []
    torch.manual_seed(0)
    for own, other in ((0, 1), (1, 0)):
        noise = torch.randn(DRAWS, *emission.shape[:-2], emission.noise, dtype=torch.float64)
        scores = torch.stack([emission.log_density(emission.draw(one)[..., own, :]) for one in noise])
        assert torch.isfinite(scores[..., own]).all()
        shares.append((scores[..., other] - scores[..., own]).sigmoid())
    error = ((shares[0].var(0) + shares[1].var(0)) / DRAWS).sqrt()
    assert ((shares[0].mean(0) - shares[1].mean(0)).abs() < 5 * error + 1e-9).all()


@pytest.mark.parametrize(
    "kind", ["gaussian", "gaussian, own σ", "gaussian, σ of each step", "binary", "categorical", "product"]
)
def test_divergences_are_those_of_torch(kind):
    emission = KINDS[kind]()
    if kind == "product":  # the clipped part counts as the normal before it is clipped
        normal = Gaussian(emission.groups[0][1].mean, STD, SCALE.log()).divergence(0)
        torch.testing.assert_close(emission.divergence(0), normal + emission.groups[1][1].divergence(0))
        return
    distributions = torch.distributions
    if kind.startswith("gaussian"):
        std = emission.std.expand(emission.mean.shape)
        p, q = (distributions.Normal(emission.mean[..., k, :], std[..., k, :]) for k in (0, 1))
    elif kind == "binary":
        p, q = (distributions.Bernoulli(logits=emission.logits[..., k, :]) for k in (0, 1))
    else:
        p, q = (distributions.Categorical(logits=emission.logits[..., k, :]) for k in (0, 1))
    both = 0.5 * (distributions.kl_divergence(p, q) + distributions.kl_divergence(q, p))
    expected = both if kind == "categorical" else both.sum(-1)
    torch.testing.assert_close(emission.divergence(0)[..., 1], expected)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("depth", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_every_kind_at_every_depth_has_one_likelihood(kind, depth):
    """Brute force, Pyro's enumeration of the program and the compiled pass."""
    steps, actions = 3 if depth < 3 else 2, actions_of(kind)
    generator = torch.Generator().manual_seed(depth)

    def draw(*shape):
        return torch.randn(2, steps, *shape, generator=generator, dtype=torch.float64)

    emission = KINDS[kind]().map(lambda t: t[:, :steps] if t.dim() == 4 else t)
    callers = [CallerOutputs(0, None, emission)]
    callers += [CallerOutputs(2, draw(2 if level < depth - 1 else 1, 2), None) for level in range(depth)]
    outputs = Outputs(tuple(callers), tuple(draw(2) for _ in range(depth)))
    lengths, actions = torch.tensor([steps, 1]), actions[:, :steps]
    tables = outputs.tables(actions)
    truth = [brute_force(tables, n, int(length)).log_likelihood for n, length in enumerate(lengths)]
    torch.testing.assert_close(log_likelihood(tables, lengths), torch.tensor(truth, dtype=torch.float64))
    check = compare_engines(outputs, actions, lengths)
    assert check.value < 1e-12
    assert check.gradient < 1e-10
