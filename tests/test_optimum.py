"""Training reaches an optimum that is known without it: least squares."""

from __future__ import annotations

import numpy as np
import pytest
from planted import small_spec
from random_demonstrations import numbered
from scipy import stats

from ddco_pyro.fitting.fit import fit

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
