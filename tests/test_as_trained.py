"""Step by step, as a policy acts, every network says what it says of a whole demonstration, as it is trained."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from exportable import SHAPES, make

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.model.batch import encode

LONGEST = 6  # steps that networks for each step of time are made for
LENGTHS = (6, 4, 9)

NETWORKS = {
    "linear": {"network": "linear"},
    "mlp": {"network": "mlp", "hidden": [8, 8], "dropout": 0.5},
    "per_timestep": {"network": "per_timestep", "hidden": [8]},
    "conv": {"network": "conv", "hidden": [8], "filters": 4},
}
MODELS = {"flat": (), "options": (3,), "hybrid": (2, 2)}


def recorded(camera):
    random = np.random.default_rng(0)
    records = []
    for number, steps in enumerate(LENGTHS):
        seen = {"state": random.normal(5, 2, (steps, 3)), "goal": random.normal(-1, 3, (steps, 2, 2))}
        if camera:
            seen["camera"] = random.integers(0, 256, (steps, *SHAPES["camera"]), dtype=np.uint8)
        records.append(Demonstration(f"demo_{number}", seen, random.normal(40, 9, (steps, 2))))
    return Demonstrations(tuple(records))


@pytest.fixture(scope="module", params=[(network, model) for network in NETWORKS for model in MODELS], ids="-".join)
def trained(request):
    """A model, demonstrations, and the outputs of its networks for all of them in one padded batch."""
    network, counts = NETWORKS[request.param[0]], MODELS[request.param[1]]
    camera = request.param[0] == "conv"
    emits = ("options", "control") if len(counts) > 1 else ("options",)
    demos, hierarchy = recorded(camera), make(network, counts, emits, camera, LONGEST, endings=network).hierarchy
    hierarchy.encoder.fit(demos)
    hierarchy.scaling.fit(demos)
    with torch.no_grad():
        return hierarchy, demos, hierarchy(encode(demos, hierarchy.encoder, hierarchy.scaling).inputs)


def test_the_controller(trained):
    """The control is the mean of whoever acts in its own units, ψ that of the active options."""
    hierarchy, demos, whole = trained
    controller, actors = Controller(hierarchy), set()
    for number, demo in enumerate(demos):
        for seed in range(2):
            controller.reset(seed)
            for t in range(len(demo)):
                control = controller.act({key: values[t] for key, values in demo.observations.items()})
                choices = controller.choices
                level = next((d for d, choice in enumerate(choices) if choice), -1)
                mean = whole.emissions[level].mean[number, t, choices[level] - 1 if level >= 0 else 0]
                np.testing.assert_allclose(control, hierarchy.scaling.unscaled(mean), atol=1e-4)
                psi = [
                    log[number, t, h - 1, 1].exp() if h else 1
                    for log, h in zip(whole.termination, choices, strict=True)
                ]
                assert controller.terminations == pytest.approx([float(one) for one in psi], abs=1e-5)
                actors.add(level)
    assert actors == {0: {-1}, 1: {0}, 2: {0, 1, -1}}[hierarchy.depth]
