"""One observation at a time gives what the networks saw of the whole demonstration."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ddco_pyro.acting.window import ObservationError, Window
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.model.encoder import ObservationEncoder
from ddco_pyro.spec import ObservationSpec


def make_encoder(differences=True):
    specs = [ObservationSpec(key="state", differences=differences), ObservationSpec(key="step")]
    encoder = ObservationEncoder(specs, {"state": (2,)})
    states = np.random.default_rng(0).normal(size=(7, 2))
    demos = Demonstrations((Demonstration("demo_0", {"state": states}, np.zeros((7, 1))),))
    encoder.fit(demos)
    return encoder, states


@pytest.mark.parametrize("differences", [True, False])
def test_steps_are_those_of_the_whole_demonstration(differences):
    encoder, states = make_encoder(differences)
    whole = encoder.inputs([{"state": states}])
    window = Window(encoder)
    for t, state in enumerate(states):
        one = window.inputs([{"state": state}])
        assert one.time.tolist() == [t]
        torch.testing.assert_close(one.vector[0, 0], whole.vector[0, t])
        assert one.vectors["step"].shape == (1, 1, 1)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"other": np.zeros(2)}, r"has no 'state' \(it has: other\)"),
        ({"state": np.zeros(3)}, r"'state' has shape \(3,\), the demonstrations had \(2,\)"),
        ({"state": np.array([0.0, np.nan])}, "'state' is not finite"),
    ],
)
def test_what_cannot_be_used_is_refused_and_leaves_the_window_as_it_was(observation, message):
    encoder, states = make_encoder()
    refusing, other = Window(encoder), Window(encoder)
    refusing.inputs([{"state": states[0]}])
    other.inputs([{"state": states[0]}])
    with pytest.raises(ObservationError, match=message):
        refusing.inputs([observation])
    found, expected = refusing.inputs([{"state": states[1]}]), other.inputs([{"state": states[1]}])
    torch.testing.assert_close(found.vector, expected.vector)
    assert found.time.tolist() == [1]
