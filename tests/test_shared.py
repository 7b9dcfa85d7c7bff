"""A network that options share, against copies of their own with the same weights."""

from __future__ import annotations

import pytest
import torch
from stacked_networks import COPIES, FEATURES, LONGEST, PIXELS, answer, assert_close, make, random_inputs

from ddco_pyro.model.networks import InputShape, ShapeError, build_trunk
from ddco_pyro.spec import network_spec

SEEING = {
    "network": "branches",
    "of": {
        "camera": {"network": "conv", "filters": 2, "pool": "flatten", "hidden": [4], "shared": True},
        "vector": {"network": "lstm", "hidden": 3, "shared": True},
        "own": {"network": "mlp", "inputs": ["vector"], "hidden": [5]},
    },
    "hidden": [6],
}


def test_what_options_share_is_what_each_would_give_with_these_weights_and_learns_from_all():
    """Copies of their own, given the shared weights, give the same; the shared gradient is the sum of theirs."""
    shape = InputShape({"vector": FEATURES}, {"camera": PIXELS})
    alone = {name: each | {"shared": False} for name, each in SEEING["of"].items()}
    shared = build_trunk(network_spec(**SEEING), shape, COPIES)
    own = build_trunk(network_spec(**SEEING | {"of": alone}), shape, COPIES)
    weights = own.state_dict()
    for name, values in shared.state_dict().items():
        repeats = weights[name].shape[0] // values.shape[0]
        weights[name] = values.repeat(repeats, *[1] * (values.dim() - 1))
    own.load_state_dict(weights)
    inputs = random_inputs(shape, 2, LONGEST, 0)
    found, expected = answer(shared, inputs)[0], answer(own, inputs)[0]
    assert_close(found, expected)
    found.square().sum().backward()
    expected.square().sum().backward()
    of_copies = own.of[0].convolutions[0][0].weight.grad.unflatten(0, (COPIES, -1)).sum(0)
    torch.testing.assert_close(shared.of[0].convolutions[0][0].weight.grad, of_copies, rtol=1e-4, atol=1e-5)


def test_a_policy_that_options_would_share_is_refused():
    with pytest.raises(ShapeError, match=r"^shared: options would all do the same"):
        make(network="mlp", shared=True)
