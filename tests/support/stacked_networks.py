"""Small stacked networks, inputs for them, and ordinary torch networks with the same weights."""

import pytest
import torch
from pydantic import TypeAdapter
from torch import nn

from ddco_pyro.model.networks import Inputs, InputShape, ShapeError, build
from ddco_pyro.model.networks.perceptrons import StackedLinear
from ddco_pyro.spec import NetworkSpec

FEATURES, OUTPUTS, COPIES, LONGEST = 3, 2, 4, 5
SHAPE = InputShape({"state": FEATURES}, {}, LONGEST)
PIXELS = (14, 18, 3)


def make(shape=SHAPE, **settings):
    torch.manual_seed(0)
    return build(TypeAdapter(NetworkSpec).validate_python(settings), shape, OUTPUTS, COPIES).eval()


def answer(network, inputs, state=None):
    """What a network gives; without a state, at the first step."""
    return network(inputs, network.initial_state(inputs.batch[0]) if state is None else state)


def make_inputs(trajectories=2, steps=LONGEST, start=0, images=()):
    shape = InputShape({"state": FEATURES}, dict.fromkeys(images, PIXELS))
    return random_inputs(shape, trajectories, steps, start)


def random_inputs(shape, trajectories, steps, start):
    generator = torch.Generator().manual_seed(2)
    images = {
        key: torch.randint(256, (trajectories, steps, *size), generator=generator, dtype=torch.uint8)
        for key, size in shape.images.items()
    }
    sizes = {key: (trajectories, steps, size) for key, size in shape.vectors.items()}
    vectors = {key: torch.randn(size, generator=generator) for key, size in sizes.items()}
    return Inputs(vectors, images, torch.arange(start, start + steps))


RELU = nn.ReLU()


def separate(layers, k, activation=RELU):
    """The k-th of the stacked perceptrons as an ordinary torch network with the same weights."""
    found = []
    for layer in layers:
        if isinstance(layer, StackedLinear):
            linear = nn.Linear(*layer.weight.shape[1:])
            with torch.no_grad():
                linear.weight.copy_(layer.weight[k].T)
                linear.bias.copy_(layer.bias[k, 0])
            found.append(linear)
        elif not isinstance(layer, nn.Dropout):
            found.append(activation)
    return nn.Sequential(*found)


def assert_close(found, expected):
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)


def refused(**settings):
    """The one line by which a network is refused when it is made."""
    with pytest.raises(ShapeError) as caught:
        make(**settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)
