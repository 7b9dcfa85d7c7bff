"""A step alone and in its trajectory give the same: every kind of network, LSTMs, and what is refused."""

from __future__ import annotations

import pytest
import torch
from stacked_networks import COPIES, SHAPE, answer, assert_close, make, make_inputs, random_inputs, refused, separate
from torch import nn

from ddco_pyro.model.networks import CLASSES

assert set(CLASSES) == {"linear", "constant", "mlp", "per_timestep", "conv", "lstm", "branches"}, (
    "a new network belongs in every_kind"
)


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


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("alone", "has initial_state(N), which has to give a tuple of tensors [N, ...]; each call"),
        ("list", "has initial_state(N), which has to give a tuple"),
        ("without trajectories", "has initial_state(N), which has to give a tuple"),
        ("other shape", "has initial_state(N), which has to give a tuple"),
        ("forgets", "gives other outputs step by step than for a whole trajectory: its state has to hold all"),
        ("looks ahead", "gives other outputs step by step than for a whole trajectory"),
        ("over trajectories", "gives other outputs step by step than for a whole trajectory"),
    ],
)
def test_a_state_that_does_not_go_on_is_refused_when_the_network_is_made(how, message):
    said = refused(network="user_networks:Remembering", options={"how": how})
    assert said.startswith(f"network 'user_networks:Remembering' {message}")


MEMORIES = ["over time", "over trajectories", "differences", "later steps", "whole trajectory", "whole batch", "chance"]


@pytest.mark.parametrize("zero", [False, True])
@pytest.mark.parametrize("how", MEMORIES)
def test_a_network_with_a_memory_is_refused_when_it_is_made(how, zero):
    said = refused(network="user_networks:WithMemory", options={"how": how, "zero": zero})
    assert said.startswith(
        "network 'user_networks:WithMemory' gives a step alone other outputs than within its trajectory: it depends on "
        "earlier steps"
    )
