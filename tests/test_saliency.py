"""What a policy looks at, against differences of its controls, and where nothing can be seen."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.saliency import Looking, Saliency
from ddco_pyro.drawing.colours import HEIGHT, with_heat
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import parse_spec

SHAPES = {"camera": (10, 8, 3), "pose": (2,)}
CONV = {"network": "conv", "filters": 3, "kernel": 3, "pool": "spatial_softmax", "hidden": [6]}
LSTM = {"network": "lstm", "over": CONV, "hidden": 4}
STEPS = 4


def make(trunk, emits):
    spec = parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": [{"key": "camera", "frames": 2}, "pose"],
            "hierarchy": {
                "levels": [
                    {
                        "count": 2,
                        "trunk": trunk,
                        "policy": {"network": "linear"},
                        "termination": {"network": "linear"},
                    }
                ],
                "meta_policy": {**trunk, "emits": emits},
            },
        }
    )
    torch.manual_seed(0)
    return Hierarchy(spec, SHAPES, 3, steps=STEPS).eval()


def episode(seed=0):
    random = np.random.default_rng(seed)
    return [
        {"camera": random.integers(0, 256, SHAPES["camera"], dtype=np.uint8), "pose": random.normal(size=2)}
        for _ in range(STEPS)
    ]


def control(hierarchy, observations, changed, choice):
    """The control's mean at the last step, where pixels of what is seen there [H, W, 2 · C] have changed."""
    inputs = hierarchy.encoder.inputs([{key: np.stack([one[key] for one in observations]) for key in SHAPES}]).loaded()
    images = {"camera": inputs.images["camera"].double()}
    images["camera"][0, -1] += torch.as_tensor(changed)
    vectors = {key: vector.double() for key, vector in inputs.vectors.items()}
    outputs = hierarchy(type(inputs)(vectors, images, inputs.time))
    level = 0 if choice else 1
    return outputs.callers[level].numbers[0, -1, choice - 1 if choice else 0].detach().numpy()


@pytest.mark.parametrize("trunk", [CONV, LSTM], ids=["conv", "lstm"])
@pytest.mark.parametrize("choice", [2, 0], ids=["option", "meta-policy"])
def test_saliency_is_the_size_of_small_differences(trunk, choice):
    """Central differences in float64, of each colour of both pictures that are seen at the last of four steps."""
    hierarchy, seen = make(trunk, ["options", "control"]), episode()
    saliency = Saliency(hierarchy)
    for observation in seen[:-1]:
        saliency.step(observation, (1,))
    look = saliency.step(seen[-1], (choice,))["camera"]
    np.testing.assert_array_equal(look.picture, seen[-1]["camera"])
    exact = hierarchy.double()
    for row, column in [(0, 0), (4, 5), (9, 7), (5, 2)]:
        squared = 0.0
        for colour in range(6):
            change = np.zeros((10, 8, 6))
            change[row, column, colour] = 1e-4
            ends = [control(exact, seen, sign * change, choice) for sign in (1, -1)]
            squared += np.square((ends[0] - ends[1]) / 2e-4).sum()
        assert look.saliency[row, column] == pytest.approx(np.sqrt(squared), rel=1e-3, abs=1e-9)
    assert look.saliency.max() > 0


def test_what_a_policy_does_not_read_has_none():
    hierarchy = make({"network": "mlp", "inputs": ["pose"]}, ["options"])
    assert not Saliency(hierarchy).step(episode()[0], (1,))["camera"].saliency.any()


def test_a_controller_that_is_looked_at_acts_as_it_does():
    hierarchy = make(LSTM, ["options", "control"])
    looking, alone = Looking(Controller(hierarchy, seed=1)), Controller(hierarchy, seed=1)
    for policy in (looking, alone):
        policy.reset(5)
    for observation in episode(1):
        np.testing.assert_array_equal(looking.act(observation), alone.act(observation))
        assert looking.choices == alone.choices
    assert [frame.shape for frame in looking.frames] == [(HEIGHT, 192, 3)] * STEPS


def test_colours_are_where_the_values_are():
    """Nothing, a half and all of a grey picture's pixels: pale grey, then the scale's middle and its end."""
    picture, values = np.full((12, 16, 3), 100, np.uint8), np.zeros((12, 16))
    values[:6, 8:], values[6:, 8:] = 0.5, 1.0
    drawn = with_heat(picture, values)
    assert drawn.shape == (240, 320, 3)
    assert (drawn[:, :160] == 255 - 155 // 2 - 1).all()
    red, green, _ = np.moveaxis(drawn[:, 160:].astype(int), -1, 0)
    assert (red[:120] > green[:120]).all()
    assert (red[120:] > green[120:] + 90).all()
