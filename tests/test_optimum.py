"""Training reaches optima that are known without it: least squares, and fixed points of expectation-maximisation."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from planted import small_spec
from random_demonstrations import numbered
from scipy import stats

from ddco_pyro.fitting.fit import fit
from ddco_pyro.spec import with_overrides

STD = 0.4  # of the control, in units of its spread


def drawn(number=16):
    """Controls that depend on a state, on how it changes, and on much that is not seen; spreads far from 1."""
    random, records = np.random.default_rng(0), []
    for index in range(number):
        steps = 8 + index % 5
        pose = 30 + 5 * np.cumsum(random.normal(size=(steps, 3)), axis=0)
        goal = np.repeat(random.normal(size=(1, 2)), steps, axis=0)
        change = np.diff(pose, axis=0, prepend=pose[:1])
        actions = 100 + pose @ [[1.0, -3.0], [0.5, 0.0], [0.0, 2.0]] + 4 * change[:, :2] + 9 * goal
        actions += [5, 30] * random.normal(size=(steps, 2))
        records.append(({"pose": pose, "goal": goal}, actions))
    return numbered(records)


@pytest.fixture(scope="module")
def flat():
    """A flat linear policy with a fixed deviation, and the demonstrations that it was fitted to."""
    spec = small_spec(
        (),
        demonstrations={"path": "unused.hdf5", "valid_fraction": 0},
        observations=[{"key": "pose", "differences": True}, "goal"],
        control={"std": STD},
        training={"epochs": 500, "patience": None, "optimizer": {"lr": 0.01}},
    )
    return fit(spec, drawn()), drawn().split(spec.training.tune_fraction, spec.seed)[0]


def features(demo):
    """What the policy is given, by hand: the pose, its change, the goal."""
    pose = demo.observations["pose"]
    return np.hstack([pose, np.diff(pose, axis=0, prepend=pose[:1]), demo.observations["goal"]])


def by_hand(found, demo):
    """The mean control of the flat policy, from its stored numbers alone."""
    tensors = {name: value.numpy() for name, value in found.hierarchy.state_dict().items()}
    inputs = (features(demo) - tensors["encoder.mean"]) / tensors["encoder.std"]
    weight, bias = (tensors[f"meta_policy.network.layers.0.{name}"][0] for name in ("weight", "bias"))
    return (inputs @ weight + bias) * tensors["scaling.scale"] + tensors["scaling.shift"]


def test_a_flat_policys_likelihood_is_that_of_a_gaussian(flat):
    """Of every demonstration, held out from training or not, in the control's own units."""
    found, demos = flat
    assert len(demos) < len(drawn())
    spread = np.concatenate([demo.actions for demo in demos]).std(0)
    expected = [stats.norm.logpdf(demo.actions, by_hand(found, demo), STD * spread).sum() for demo in drawn()]
    np.testing.assert_allclose(found.log_likelihood(drawn()), expected, rtol=1e-5)


def test_a_flat_linear_policy_reaches_least_squares(flat):
    found, demos = flat
    rows, actions = np.concatenate([features(demo) for demo in demos]), np.concatenate([demo.actions for demo in demos])
    inputs = np.hstack([(rows - rows.mean(0)) / rows.std(0), np.ones((len(rows), 1))])
    weights, *_ = np.linalg.lstsq(inputs, actions, rcond=None)
    best = stats.norm.logpdf(actions, inputs @ weights, STD * actions.std(0)).sum() / len(rows)
    value = found.log_likelihood(demos).sum() / len(rows)
    assert value == pytest.approx(best, abs=1e-5)
    means = np.concatenate([by_hand(found, demo) for demo in demos])
    np.testing.assert_allclose(means, inputs @ weights, atol=1e-3 * actions.std(0).min())


# --- expectation-maximisation -----------------------------------------------------------------------------------------


def skills(number=16, steps=12):
    """Two skills, told apart by the sign of ``turn`` and by how long they have lasted."""
    random, records = np.random.default_rng(1), []
    for _ in range(number):
        turn = np.where(np.arange(steps) < random.integers(4, 9), 1.0, -1.0)[:, None]
        place = random.normal(size=(steps, 2))
        actions = turn * place @ [[1.0, 0.3], [-0.4, 0.8]] + 0.5 * (turn > 0) + 0.2 * random.normal(size=(steps, 2))
        seen = {"place": place, "turn": turn + 0.5 * random.normal(size=(steps, 1))}
        records.append((seen, actions))
    return numbered(records)


@pytest.fixture(scope="module")
def options():
    """Runs of a hierarchy with linear options, after one epoch and at the end, and their training demonstrations."""
    spec = small_spec(
        demonstrations={"path": "unused.hdf5", "valid_fraction": 0},
        observations=["place", "turn"],
        control={"std": 0.3},
        training={"initialize": "vq_controls", "layerwise": False, "patience": None, "optimizer": {"lr": 0.01}},
    )
    found = {epochs: fit(with_overrides(spec, {"training.epochs": epochs}), skills()) for epochs in (1, 400)}
    return found, skills().split(spec.training.tune_fraction, spec.seed)[0]


def maximised(found, demos):
    """A copy of the run whose options' policies are those that the M-step gives in closed form: least squares, weighted
    by the posterior of each option.
    """
    tensors = {name: value.numpy() for name, value in found.hierarchy.state_dict().items()}
    rows = np.concatenate([np.hstack([demo.observations["place"], demo.observations["turn"]]) for demo in demos])
    inputs = np.hstack([(rows - tensors["encoder.mean"]) / tensors["encoder.std"], np.ones((len(rows), 1))])
    actions = np.concatenate([demo.actions for demo in demos])
    scaled = (actions - tensors["scaling.shift"]) / tensors["scaling.scale"]
    posterior = found.posterior(demos).u[0].numpy()
    u = np.concatenate([row[: len(demo)] for row, demo in zip(posterior, demos, strict=True)])
    hierarchy = copy.deepcopy(found.hierarchy)
    (layer,) = hierarchy.levels[0].policy.network.layers
    with torch.no_grad():
        for option in range(2):
            weight = np.sqrt(u[:, [option + 1]])
            solution, *_ = np.linalg.lstsq(weight * inputs, weight * scaled, rcond=None)
            layer.weight[option], layer.bias[option, 0] = (torch.tensor(part) for part in (solution[:-1], solution[-1]))
    return replace(found, hierarchy=hierarchy)


def test_maximising_what_the_posterior_expects_raises_the_likelihood(options):
    """As expectation-maximisation has to from wherever it starts; where training ended nothing is left to be raised."""
    found, demos = options
    steps = sum(demos.lengths)
    gains = {}
    for epochs, run in found.items():
        before, after = (one.log_likelihood(demos).sum() / steps for one in (run, maximised(run, demos)))
        gains[epochs] = after - before
    assert gains[1] > 0.05
    assert abs(gains[400]) < 1e-5
