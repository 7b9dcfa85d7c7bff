"""What each branch of the networks is worth, and how strongly it acts."""

import numpy as np
import pytest
import torch

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.evaluation.branch_use import branch_use
from ddco_pyro.report import write_report
from ddco_pyro.spec import parse_spec

HEADS = {"policy": {"network": "linear"}, "termination": {"network": "linear"}}
MLP = {"network": "mlp", "hidden": [8]}
BRANCHES = {"network": "branches", "of": {"seen": MLP, "noise": MLP | {"activation": "tanh"}}, "hidden": [16]}


def demonstrations(number=12, steps=20):
    """What is seen decides the control; noise does not."""
    random, made = np.random.default_rng(0), []
    for n in range(number):
        seen, noise = random.normal(size=(2, steps, 2))
        controls = seen + random.normal(0, 0.1, seen.shape)
        made.append(Demonstration(f"demo_{n}", {"seen": seen, "noise": noise}, controls))
    return Demonstrations(tuple(made))


def spec_of(level, trunk):
    levels = [{"count": 2, **level}]
    return parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5", "valid_fraction": 0.25},
            "observations": ["seen", "noise"],
            "control": {"std": {"learn": True}},
            "hierarchy": {"trunk": trunk, "levels": levels, "meta_policy": {"network": "linear"}},
            "training": {"epochs": 60, "optimizer": {"lr": 0.03}, "layerwise": False},
        }
    )


@pytest.fixture(scope="module", params=["policy", "whole"])
def fitted(request, tmp_path_factory):
    level = HEADS if request.param == "whole" else {"policy": BRANCHES}
    out = tmp_path_factory.mktemp("runs") / request.param
    trunk = BRANCHES if request.param == "whole" else None
    return ddco_pyro.fit(spec_of(level, trunk), demonstrations(), out=out)


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
    network = fitted.hierarchy.trunk or level.policy.network
    u = piece.posterior.u[0][..., 1:]
    for column, branch in enumerate(network.of):
        with torch.no_grad():
            units = branch(piece.batch.inputs, branch.initial_state(4))[0].double().abs().mean(-1)
        expected = (u * units).sum((0, 1)) / u.sum((0, 1))
        np.testing.assert_allclose([row[column] for row in use.activation], expected, rtol=1e-6)


@pytest.mark.parametrize("fitted", ["whole"], indirect=True)
def test_the_report_shows_them(fitted):
    page = write_report(fitted, demonstrations()).read_text()
    assert "Which inputs matter" in page
    assert "Nats per step lost" in page
