"""The live monitor against the model's likelihood and posterior of the same demonstration."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hierarchies import make_hierarchy

from ddco_pyro.acting.monitor import Monitor
from ddco_pyro.acting.window import ObservationError
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.inference import log_likelihood, posterior
from ddco_pyro.model.batch import encode


def demonstration(steps):
    rng = np.random.default_rng(0)
    return Demonstration("demo_0", {"state": rng.normal(size=(steps, 3))}, rng.normal(size=(steps, 2)))


WINDOWS = {"network": "lstm", "horizon": 4}


@pytest.mark.parametrize(
    ("counts", "network"),
    [((3,), "mlp"), ((2, 2), "mlp"), ((2, 2), "lstm"), pytest.param((2, 2), WINDOWS, id="windows")],
)
def test_what_it_says_at_the_end_is_what_the_demonstration_says(counts, network):
    """Before the last control is known, the belief is the posterior of the demonstration without that control."""
    hierarchy, demo = make_hierarchy(counts, ("options", "control"), network), demonstration(6)
    monitor = Monitor(hierarchy)
    for t in range(6):
        belief = monitor.step({"state": demo.observations["state"][t]}, demo.actions[t - 1] if t else None)
    with torch.no_grad():
        batch = encode(Demonstrations([demo]), hierarchy.encoder, hierarchy.scaling)
        tables = hierarchy.tabulate(batch)
        before = log_likelihood(tables, torch.tensor([5]))
        for table in tables.control:
            table[:, -1] = 0.0
        expected = posterior(tables, batch.lengths)
    assert monitor.log_likelihood == pytest.approx(float(before), rel=1e-6)
    for d, level in enumerate(belief.levels):
        torch.testing.assert_close(level[0].sum(-1), expected.u[d][0, -1], atol=1e-6, rtol=0)
        torch.testing.assert_close(level[0, :, 1], expected.v[d][0, -1], atol=1e-6, rtol=0)


@pytest.mark.parametrize("network", ["mlp", "lstm"])
def test_reset_forgets(network):
    hierarchy, demo = make_hierarchy((3,), network=network), demonstration(3)
    monitor = Monitor(hierarchy)
    first = monitor.step({"state": demo.observations["state"][0]})
    monitor.step({"state": demo.observations["state"][1]}, demo.actions[0])
    monitor.reset()
    torch.testing.assert_close(monitor.step({"state": demo.observations["state"][0]}).levels, first.levels)


def test_the_control_comes_with_every_observation_but_the_first():
    monitor, state = Monitor(make_hierarchy((3,))), {"state": np.zeros(3)}
    with pytest.raises(ObservationError, match="no control comes before the first observation"):
        monitor.step(state, np.zeros(2))
    monitor.reset()
    monitor.step(state)
    with pytest.raises(ObservationError, match=r"shape \(2,\); got none"):
        monitor.step(state)
    with pytest.raises(ObservationError, match=r"got one of shape \(3,\)"):
        monitor.step(state, np.zeros(3))
