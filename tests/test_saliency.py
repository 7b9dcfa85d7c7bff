"""What a policy looks at, against differences of its controls, and where nothing can be seen."""

from __future__ import annotations

import exportable
import numpy as np
import pytest
import torch
from exportable import SHAPES, observe

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.acting.saliency import Looking, Saliency
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.drawing.colours import HEIGHT, all_with_heat, with_heat
from ddco_pyro.evaluation.branch_use import branch_use
from ddco_pyro.report import write_report
from ddco_pyro.spec import parse_spec

CONV = {"network": "conv", "filters": 3, "kernel": 3, "pool": "spatial_softmax", "hidden": [6]}
LSTM = {"network": "lstm", "over": CONV, "hidden": 4}
HEADS = {"policy": {"network": "linear"}, "termination": {"network": "linear"}}
STEPS = 4


def make(trunk, emits):
    return exportable.make("linear", (2,), emits, {"frames": 2}, STEPS, trunk=trunk, meta_policy=trunk).hierarchy


def episode(seed=0):
    random = np.random.default_rng(seed)
    return [observe(random) for _ in range(STEPS)]


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
    for row, column in [(0, 0), (4, 5), (8, 11), (5, 2)]:
        squared = 0.0
        for colour in range(6):
            change = np.zeros((9, 12, 6))
            change[row, column, colour] = 1e-4
            ends = [control(exact, seen, sign * change, choice) for sign in (1, -1)]
            squared += np.square((ends[0] - ends[1]) / 2e-4).sum()
        assert look.saliency[row, column] == pytest.approx(np.sqrt(squared), rel=1e-3, abs=1e-9)
    assert look.saliency.max() > 0


def test_what_a_policy_does_not_read_has_none():
    hierarchy = make({"network": "mlp", "inputs": ["goal"]}, ["options"])
    assert not Saliency(hierarchy).step(episode()[0], (1,))["camera"].saliency.any()


def test_a_controller_that_is_looked_at_acts_as_it_does():
    hierarchy = make(LSTM, ["options", "control"])
    looking, alone = Looking(Controller(hierarchy, seed=1)), Controller(hierarchy, seed=1)
    for policy in (looking, alone):
        policy.reset(5)
    for observation in episode(1):
        np.testing.assert_array_equal(looking.act(observation), alone.act(observation))
        assert looking.choices == alone.choices
    assert [all_with_heat(looks).shape for looks in looking.looks] == [(HEIGHT, HEIGHT * 4 // 3, 3)] * STEPS


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


# --- which branches matter --------------------------------------------------------------------------------------------


BRANCHES = {
    "network": "branches",
    "of": {"seen": {"network": "mlp", "hidden": [8]}, "noise": {"network": "mlp", "hidden": [8], "activation": "tanh"}},
    "hidden": [16],
}


def demonstrations(number=12, steps=20):
    """What is seen decides the control; noise does not."""
    random, made = np.random.default_rng(0), []
    for n in range(number):
        seen, noise = random.normal(size=(2, steps, 2))
        controls = seen + random.normal(0, 0.1, seen.shape)
        made.append(Demonstration(f"demo_{n}", {"seen": seen, "noise": noise}, controls))
    return Demonstrations(tuple(made))


def spec_of(level, trunk):
    return parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5", "valid_fraction": 0.25},
            "observations": ["seen", "noise"],
            "control": {"std": {"learn": True}},
            "hierarchy": {"trunk": trunk, "levels": [{"count": 2, **level}], "meta_policy": {"network": "linear"}},
            "training": {"epochs": 60, "optimizer": {"lr": 0.03}, "layerwise": False},
        }
    )


@pytest.fixture(scope="module", params=["policy", "trunk", "whole"])
def fitted(request, tmp_path_factory):
    level = {} if request.param == "whole" else {request.param: BRANCHES}
    if request.param != "policy":
        level |= HEADS
    out = tmp_path_factory.mktemp("runs") / request.param
    return ddco_pyro.fit(spec_of(level, BRANCHES if request.param == "whole" else None), demonstrations(), out=out)


def test_what_decides_the_control_is_told_from_what_does_not(fitted):
    use, *_ = fitted.metrics.branches
    assert (use.level, use.branches) == (0, ["seen", "noise"])
    for seen, noise in use.loss:
        assert seen > 1.0
        assert abs(noise) < 0.3 * seen


def test_activations_are_the_mean_sizes_of_what_the_branches_give(fitted):
    """By hand: each branch called alone, its units' mean size, weighted by the posterior."""
    demos = demonstrations(4)
    use, *_ = branch_use(fitted.hierarchy, fitted.infer(demos))
    (piece,) = fitted.infer(demos)
    level = fitted.hierarchy.levels[0]
    network = fitted.hierarchy.trunk or level.trunk or level.policy.network
    u = piece.posterior.u[0][..., 1:]
    for column, branch in enumerate(network.of):
        with torch.no_grad():
            units = branch(piece.batch.inputs, branch.initial_state(4))[0].double().abs().mean(-1)
        expected = (u * units).sum((0, 1)) / u.sum((0, 1))
        np.testing.assert_allclose([row[column] for row in use.activation], expected, rtol=1e-6)


def test_the_networks_are_as_they_were_afterwards(fitted):
    demos = demonstrations(4)
    before = fitted.log_likelihood(demos)
    branch_use(fitted.hierarchy, fitted.infer(demos))
    np.testing.assert_array_equal(fitted.log_likelihood(demos), before)


@pytest.mark.parametrize("fitted", ["whole"], indirect=True)
def test_the_report_shows_them(fitted):
    page = write_report(fitted, demonstrations()).read_text()
    assert "Which inputs matter" in page
    assert (fitted.folder / "figures" / "branches.png").exists()
