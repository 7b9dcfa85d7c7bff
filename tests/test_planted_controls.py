"""Hierarchies planted with controls that reach their bounds, and with a switch, are found again."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from planted import make_spec, make_trainer, make_truth, plant, recovered

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.controls import ControlPart, control_parts
from ddco_pyro.training.networks import Dimensions

BOUND = 0.12
"""Far from its corner an option is on a bound nearly always: more than half of the controls are."""

TRAINING = {"epochs": 200, "restarts": 1, "patience": 30, "initialize": "vq_controls"}
CLIPPED = (ControlPart("clipped", (0, 1), "clipped", low=(-BOUND, -BOUND), high=(BOUND, BOUND)),)
SWITCHED = (ControlPart("hand", (0, 1), "gaussian"), ControlPart("jaw", (2,), "binary", low=(0.0,), high=(0.42,)))


def learned(kind, count=4):
    control = {"kind": kind, "std": {"learn": True, "floor": 0.005}, "scale": "none"}
    return make_spec((count,), control=control, **TRAINING)


def test_options_with_saturated_controls_are_recovered(tmp_path):
    """Clipped emissions find them and reach the truth's held-out likelihood, and Gaussian ones are no better."""
    truth = make_truth(make_spec((3,), control={"std": 0.03, "scale": "none"}), parts=CLIPPED)
    demos, _ = plant(truth, 40, 25, seed=1)
    held_out = plant(truth, 30, 25, seed=2)
    controls = np.concatenate([demo.actions for demo in demos])
    assert (np.abs(controls) == BOUND).mean() > 0.3
    auto = make_trainer(learned("auto", 3), demos, tmp_path / "auto")
    assert [part.kind for part in auto.hierarchy.scaling.parts] == ["clipped"]
    found = recovered(auto.run(), truth, *held_out)
    gaussian = recovered(make_trainer(learned("gaussian", 3), demos, tmp_path / "gaussian").run(), truth, *held_out)
    assert found["found nmi"][0] > 0.98 * found["truth nmi"][0]
    assert found["found"] > found["truth"] - 0.1
    assert found["found nmi"][0] > gaussian["found nmi"][0] - 0.02


@pytest.fixture(scope="module")
def switched():
    """Two options that move and two that hold the jaw closed, and demonstrations of them."""
    truth = make_truth(make_spec((4,), control={"std": 0.03, "scale": "none"}), parts=SWITCHED)
    with torch.no_grad():
        truth.levels[0].policy.network.layers[0].bias[:, 0, 2] = torch.tensor([4.0, -4.0, 4.0, -4.0])
    return plant(truth, 40, 25, seed=1)[0]


def switches(jaw):
    """How often the jaw changes, per step, over episodes [N, T]."""
    return float((np.diff(jaw, axis=1) != 0).mean())


def test_a_switch_is_never_half_open_and_switches_as_often(switched, tmp_path):
    """Rolled out in the plane that the demonstrations were made in."""

    parts = control_parts(learned("auto").control, Dimensions.of(switched).control)
    assert {part.kind: part.dims for part in parts} == {"gaussian": (0, 1), "binary": (2,)}
    model = make_trainer(learned("auto"), switched, tmp_path / "fit").run()
    controller, jaws = Controller(model, "sample"), []
    controller.reset_all(range(100))
    state = np.random.default_rng(0).uniform(-1, 1, (100, 2))
    for _ in range(30):
        controls = controller.act_all([{"state": row} for row in state])
        jaws.append(controls[:, 2])
        state = (state + controls[:, :2]).clip(-1, 1)
    rolled = np.stack(jaws, axis=1)
    assert set(np.unique(rolled)) == {0.0, 0.42}
    demonstrated = np.stack([demo.actions[:, 2] for demo in switched])
    error = (0.25 / rolled.size) ** 0.5
    assert abs(switches(rolled) - switches(demonstrated)) < 0.03 + 3 * error
    assert abs((rolled > 0).mean() - (demonstrated > 0).mean()) < 0.1
