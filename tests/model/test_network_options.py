"""What a spec may say of a network is what the network's class takes."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from ddco_pyro.model.networks import CLASSES, InputShape, build
from ddco_pyro.spec import SpecError, network_spec, parse_spec
from ddco_pyro.spec.networks import SETTINGS
from ddco_pyro.training.networks import Dimensions, check_models

SHAPE = InputShape({"state": 3}, {}, 5)


# --- built-in ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CLASSES)
def test_the_settings_of_a_spec_reach_the_network(name):
    other = {"hidden": [7, 9], "dropout": 0.25, "activation": "elu", "layers": [{"filters": 2, "kernel": 3}]}
    given = {key: value for key, value in other.items() if key in SETTINGS[name].model_fields}
    shape = InputShape({"state": 3}, {"camera": (6, 6, 3)} if name == "conv" else {}, 5)
    if name == "branches":
        given["of"] = {"state": network_spec(network="linear")}
    network = build(network_spec(network=name, **given), shape, 2, 4)
    if name == "lstm":
        assert [layer.recurrent.shape for layer in network.memory] == [(4, 7, 28), (4, 9, 36)]
        return
    sizes = [layer.weight.shape[1] for layer in network.layers if hasattr(layer, "weight")]
    read = {"constant": 0, "conv": 3 + 2 * 64}.get(name, 3)
    assert sizes == [read, *given.get("hidden", [])]
    assert {layer.p for layer in network.layers if isinstance(layer, nn.Dropout)} == (
        {0.25} if "dropout" in given else set()
    )
    assert sum(isinstance(layer, nn.ELU) for layer in network.layers) == len(given.get("hidden", []))
    if name == "conv":
        assert network.convolutions[0][0].weight.shape == (2 * 4, 3, 3, 3)


# --- a user's ---------------------------------------------------------------------------------------------------------


class Own(nn.Module):
    """A network of one's own with options."""

    def __init__(self, shape, outputs, copies, width, gain=1.0):
        super().__init__()
        self.given, self.size = {"width": width, "gain": gain}, (copies, outputs)

    def forward(self, inputs):
        return torch.zeros(*inputs.batch, *self.size)


def test_options_are_the_classs_own_arguments():
    spec = network_spec(network=f"{__name__}:Own", options={"width": [3, 4]})
    assert build(spec, SHAPE, 2, 4).module.given == {"width": [3, 4], "gain": 1.0}


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({}, "missing 1 required positional argument: 'width'"),
        ({"width": 1, "gian": 2}, "got an unexpected keyword argument 'gian'"),
        ({"width": 1, "shape": 3}, "got multiple values for argument 'shape'"),
    ],
)
@pytest.mark.parametrize("place", ["hierarchy.levels.0.termination", "compare_with.0.policy"])
def test_options_that_the_class_does_not_take_are_one_line_with_its_own_error(options, why, place):
    own = {"network": f"{__name__}:Own", "options": options}
    changes = {"compare_with": [{"kind": "flat", "policy": own}]} if "compare" in place else {place: own}
    spec = parse_spec({"task": "toy", "observations": ["pose"], "hierarchy": {"levels": [{"count": 2}]}}, changes)
    with pytest.raises(SpecError) as caught:
        check_models(spec, Dimensions({"pose": (3,)}, control_size=2, steps=5))
    (problem,) = caught.value.problems
    assert problem.startswith(f"{place}: network '{__name__}:Own' cannot be made with options {options}: ")
    assert why in problem
    assert "\n" not in problem
