"""A policy is learnt from pictures, end to end."""

from __future__ import annotations

import numpy as np
import pytest

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.spec import parse_spec

SIZE, STEPS = 24, 12
CONVOLUTION = {
    "network": "conv",
    "layers": [{"filters": 4, "kernel": 5, "stride": 2, "padding": 2}, {"filters": 4, "kernel": 3, "padding": 1}],
    "pool": "spatial_softmax",
    "hidden": [16],
}


def followed(number, seed):
    """A blob moves along a line through a picture, and the control is its place, from -1 to 1."""
    random, demos = np.random.default_rng(seed), []
    rows = columns = np.linspace(-1, 1, SIZE)
    for n in range(number):
        ends = random.uniform(-0.8, 0.8, (2, 2))
        place = np.linspace(*ends, STEPS)
        distance = (rows[:, None] - place[:, :1, None]) ** 2 + (columns - place[:, 1:, None]) ** 2
        pictures = (255 * np.exp(-distance / 0.05)).astype(np.uint8)[..., None]
        demos.append(Demonstration(f"demo_{n}", {"camera": pictures}, place + 0.02 * random.normal(size=place.shape)))
    return Demonstrations(tuple(demos))


@pytest.mark.parametrize("policy", [CONVOLUTION, {"network": "lstm", "over": CONVOLUTION, "hidden": 16}])
def test_a_blob_is_followed(policy):
    """With less than a fifth of the error of the best control that does not look."""
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": ["camera"],
            "control": {"std": 0.1, "scale": "none"},
            "baseline": {"kind": "flat", "policy": policy},
            "training": {"epochs": 60, "batch_size": 4, "optimizer": {"lr": 0.01}},
        }
    )
    controller, new = ddco_pyro.fit(spec, followed(16, 0)).controller(), followed(8, 1)
    squared = []
    for demo in new:
        controller.reset()
        acted = [controller.act({"camera": picture}) for picture in demo.observations["camera"]]
        squared.append(np.square(acted - demo.actions).mean())
    unseen = np.concatenate([demo.actions for demo in new]).std(0)
    assert np.sqrt(np.mean(squared)) < 0.2 * np.sqrt(np.square(unseen).mean())
