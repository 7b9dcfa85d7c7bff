"""LSTMs, with and without windows, against torch's own with the same weights."""

import pytest
import torch
from stacked_networks import COPIES, SHAPE, answer, assert_close, make, make_inputs, random_inputs, separate
from torch import nn


def separate_memory(network, k):
    """The k-th of the stacked memories, layer by layer, as torch's own with the same weights."""
    for layer in network.memory:
        alone = nn.LSTM(layer.inputs.weight.shape[1], layer.size[1], batch_first=True)
        with torch.no_grad():
            alone.weight_ih_l0.copy_(layer.inputs.weight[k].T)
            alone.weight_hh_l0.copy_(layer.recurrent[k].T)
            alone.bias_ih_l0.copy_(layer.inputs.bias[k, 0])
            alone.bias_hh_l0.zero_()
        yield alone


@pytest.mark.parametrize("over", [None, {"hidden": [7]}])
def test_lstms_are_separate_networks(over):
    network, inputs = make(network="lstm", over=over, hidden=[6, 5]), make_inputs()
    expected = []
    for k in range(COPIES):
        values = separate(network.over.layers, k)(inputs.vector) if over else inputs.vector
        for alone in separate_memory(network, k):
            values, _ = alone(values)
        expected.append(separate(network.layers, k)(values))
    assert_close(answer(network, inputs)[0], torch.stack(expected, dim=2))


@pytest.mark.parametrize("start", [0, 4, 9, 11])
@pytest.mark.parametrize("horizon", [1, 3, 5, 20])
def test_a_memory_with_a_horizon_is_made_afresh_for_each_window(horizon, start):
    """Windows are counted from the first step of a trajectory, at whichever step a call begins."""
    network, k = make(network="lstm", hidden=[6, 5], horizon=horizon), COPIES - 1
    everything = random_inputs(SHAPE, 2, 23, 0)
    expected = []
    for first in range(0, 23, horizon):
        values = everything.vector[:, first : first + horizon]
        for alone in separate_memory(network, k):
            values, _ = alone(values)
        expected.append(separate(network.layers, k)(values))
    said, state = [], None
    for part in (slice(0, start), slice(start, None)) if start else (slice(None),):
        outputs, state = answer(network, everything.part(slice(None), part), state)
        said.append(outputs[:, :, k])
    assert_close(torch.cat(said, dim=1), torch.cat(expected, dim=1))
