"""A σ that depends on the state: density, start, what it is worth, and that it is no confound of options."""

import numpy as np
import pytest
import torch
from hierarchies import make_batch, make_hierarchy, varied
from planted import LINEAR, small_spec
from random_demonstrations import numbered
from scipy import stats

import ddco_pyro
from ddco_pyro.inference.engines import compare_engines
from ddco_pyro.model.controls import INITIAL_STD
from ddco_pyro.model.hierarchy import Dimensions, Hierarchy

OF_STATE = {"learn": True, "per_state": True}
OF_OPTION = {"learn": True, "per_option": True}


def softplus(values):
    return np.log1p(np.exp(values))


@pytest.mark.parametrize("counts", [(), (3,), (2, 2)])
def test_density_is_scipys_with_the_sigma_of_each_step(counts):
    """Of every caller, the meta-policy too: two means, then two y, by the formula of the documentation."""
    emits = ("options", "control") if counts else ("control",)
    hierarchy, batch = varied(make_hierarchy(counts, emits, std={**OF_STATE, "floor": 0.05})), make_batch()
    hierarchy.scaling.scale.copy_(torch.tensor([3.0, 0.2]))
    with torch.no_grad():
        outputs = hierarchy(batch.inputs)
    for caller in outputs.callers:
        mean, y = (values.double().numpy() for values in caller.numbers.split([2, 2], dim=-1))
        std = 0.05 + softplus(y + np.log(np.expm1(INITIAL_STD - 0.05)))
        assert np.ptp(std, axis=(0, 1)).min() > 0.05
        scale, actions = np.array([3.0, 0.2]), batch.actions.double().numpy()[:, :, None]
        expected = stats.norm.logpdf(actions * scale, mean * scale, std * scale).sum(-1)
        np.testing.assert_allclose(caller.log_density(batch.actions), expected, rtol=1e-4, atol=1e-4)
    check = compare_engines(outputs, batch.actions, batch.lengths)
    assert check.value < 1e-12
    assert check.gradient < 1e-10


NETWORKS = {
    "linear": LINEAR,
    "mlp": {"hidden": [5]},
    "per_timestep": {"network": "per_timestep"},
    "lstm": {"network": "lstm", "hidden": 3},
    "branches": {"network": "branches", "of": {"state": {"hidden": [4]}}},
}


@pytest.mark.parametrize("network", NETWORKS)
def test_at_first_it_is_the_same_everywhere(network):
    hierarchy, batch = make_hierarchy((2,), network=NETWORKS[network], std=OF_STATE), make_batch()
    for caller in hierarchy(batch.inputs).callers[:1]:
        torch.testing.assert_close(caller.emission.std, torch.full((*batch.inputs.batch, 2, 2), INITIAL_STD))
        assert caller.emission.mean.std() > 0.01
        density = caller.log_density(batch.actions).sum()
        gradient = torch.autograd.grad(density, hierarchy.levels[0].policy.parameters())
        assert all((slope != 0).any() for slope in gradient if slope.shape[-1] == 4)


def test_dimensions_with_other_sigmas_stand_beside():
    """One of the state, one of each option, one fixed."""
    parts = [{"name": "a", "dims": [2], "std": OF_STATE}, {"name": "b", "dims": [0], "std": OF_OPTION}]
    spec = small_spec(control={"std": 0.3, "parts": parts})
    hierarchy, batch = varied(Hierarchy(spec, Dimensions({"state": (3,)}, 3, 4))), make_batch()
    with torch.no_grad():
        hierarchy.levels[0].policy.std.raw_own[1] += 1
        std = hierarchy(batch.inputs).callers[0].emission.std
    assert std.shape == (2, 4, 2, 3)  # without demonstrations all dimensions are one part, in their order
    assert (std[..., 1] == 0.3).all()
    assert (std[0, 0, :, 0] == std[..., 0]).all()
    assert std[0, 0, 0, 0] < std[0, 0, 1, 0]
    assert std[..., 2].flatten().unique().numel() == 16


def noisy(number=40, steps=25):
    """Controls around a linear policy, with a spread of 0.05 + softplus(2.5 s_0 - 1); their log-densities.

    One policy does all of it: there is no skill.
    """
    random, made, densities = np.random.default_rng(0), [], []
    for _ in range(number):
        state = random.uniform(-1, 1, (steps, 2))
        mean = state @ np.array([[1.0, -0.5], [0.3, 1.0]])
        std = 0.05 + softplus(2.5 * state[:, :1] - 1 + np.array([0.0, 0.5]))
        actions = mean + std * random.normal(size=mean.shape)
        made.append(({"state": state}, actions))
        densities.append(stats.norm.logpdf(actions, mean, std).sum() / steps)
    demos = numbered(made)
    return demos, dict(zip(demos.names, densities, strict=True))


def flat_spec(**changes):
    sections = {
        "demonstrations": {"path": "unused.hdf5", "valid_fraction": 0.4},
        "control": {"std": {**OF_STATE, "floor": 0.02}, "kind": "gaussian"},
        "training": {"epochs": 150, "optimizer": {"lr": 0.03}, "batch_size": 24},
    }
    return small_spec((), **sections | changes)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A flat policy with a σ of the state, beside it one with a constant σ, and the truth's log-densities."""
    demos, truth = noisy()
    spec = flat_spec(compare_with=[{"kind": "flat", "policy": LINEAR, "std": {"learn": True}}])
    return ddco_pyro.fit(spec, demos, out=tmp_path_factory.mktemp("runs") / "flat"), demos, truth


def test_a_planted_sigma_of_the_state_is_found(fitted):
    """Held out: as good as the truth, and better than constant σ, least squares, by many standard errors."""
    fit, demos, truth = fitted
    names = [row.name for row in fit.metrics.valid]
    found = fit.metrics.log_likelihood_per_step.valid
    assert found == pytest.approx(np.mean([truth[name] for name in names]), abs=0.02)
    kept = [[demo for demo in demos if (demo.name in names) == held_out] for held_out in (False, True)]
    train, valid = kept
    seen, actions = zip(*(_rows(part) for part in (train, valid)), strict=True)
    weights = np.linalg.lstsq(seen[0], actions[0], rcond=None)[0]
    std = (actions[0] - seen[0] @ weights).std(0)
    constant = stats.norm.logpdf(actions[1], seen[1] @ weights, std).sum(-1).mean()
    other = fit.metrics.comparison["flat_2"]
    assert other.log_likelihood_per_step.valid == pytest.approx(constant, abs=0.02)
    assert other.difference.nats_per_step > 10 * other.difference.standard_error > 0
    assert fit.metrics.engine_check.gradient < 1e-6
    assert fit.metrics.parameters == 2 * 4 + 4  # two means and two y of two observations
    assert fit.baselines["flat_2"].metrics.parameters == 2 * 2 + 2 + 2
    np.testing.assert_array_equal(ddco_pyro.load(fit.folder).log_likelihood(demos), fit.log_likelihood(demos))
    assert sum(fit.metrics.log_likelihood_by_dimension.valid.by_dimension) == pytest.approx(found, rel=1e-5)


def _rows(demos):
    states = np.concatenate([demo.observations["state"] for demo in demos])
    return np.column_stack([states, np.ones(len(states))]), np.concatenate([demo.actions for demo in demos])
