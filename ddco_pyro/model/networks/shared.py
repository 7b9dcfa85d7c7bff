"""A network that all options have in common: what it sees, it learns from the steps of all of them."""

from __future__ import annotations

from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs
from ddco_pyro.model.networks.numpy_form import NumpyForm, numpy_form, over_layers
from ddco_pyro.model.networks.state import State, answer, initial_state


class Shared(nn.Module):
    """What one network gives, for each of K options; the state is that network's."""

    def __init__(self, network: nn.Module, copies: int) -> None:
        super().__init__()
        self.network, self.copies = network, copies

    def initial_state(self, trajectories: int) -> State:
        """The state of the one network."""
        return initial_state(self.network, trajectories)

    def forward(self, inputs: Inputs, state: State | None = None) -> tuple[Tensor, State]:
        """[N, T, K, features], and the state after the last step."""
        features, after = answer(self.network, inputs, state)
        return features.expand(-1, -1, self.copies, -1), after

    def numpy_form(self) -> NumpyForm | None:
        """What the numpy runner has to know of it."""
        of = numpy_form(self.network)
        return None if of is None else over_layers(of, {"kind": "shared", "copies": self.copies}, {})
