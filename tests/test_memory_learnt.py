"""What has to be remembered is learnt by networks with a state, and by no others."""

from __future__ import annotations

import numpy as np
import pytest

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.spec import parse_spec

STEPS, DELAY = 10, 4


def cued(number, seed):
    """A cue, 1 or -1, is seen at the first step alone; the control is 0 for DELAY steps, then the cue."""
    random, demos = np.random.default_rng(seed), []
    for n in range(number):
        cue = random.choice([-1.0, 1.0])
        seen = np.zeros((STEPS, 1))
        seen[0] = cue
        control = np.where(np.arange(STEPS) < DELAY, 0.0, cue)[:, None] + 0.1 * random.normal(size=(STEPS, 1))
        demos.append(Demonstration(f"demo_{n}", {"cue": seen}, control))
    return Demonstrations(tuple(demos))


def errors(model, epochs=40):
    """Root mean square error of a fitted controller after the delay, over new demonstrations."""
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["cue", "step"],
            "control": {"std": 0.2, "scale": "none"},
            "training": {"epochs": epochs, "batch_size": 10, "optimizer": {"lr": 0.02}},
            "rollout": {"options": "most_likely"},
            **model,
        }
    )
    controller, found = ddco_pyro.fit(spec, cued(30, 0)).controller(), []
    for demo in cued(20, 1):
        controller.reset()
        acted = np.stack([controller.act({"cue": cue}) for cue in demo.observations["cue"]])
        found.append(acted - np.sign(demo.observations["cue"][0]))
    return float(np.sqrt(np.square(np.stack(found)[:, DELAY:]).mean()))


def hierarchy(network):
    """Three options that each give one control until they end; the meta-policy has to know which comes next."""
    ending = {"network": "mlp", "inputs": ["step"]}
    option = {"count": 3, "policy": {"network": "linear", "inputs": ["cue"]}, "termination": ending}
    return {"hierarchy": {"levels": [option], "meta_policy": network}}


@pytest.mark.parametrize("model", [lambda network: {"baseline": {"kind": "flat", "policy": network}}, hierarchy])
def test_a_cue_is_remembered_by_an_lstm_alone(model):
    assert errors(model({"network": "lstm", "hidden": 16})) < 0.3
    assert errors(model({"network": "mlp", "hidden": [16]})) > 0.7
