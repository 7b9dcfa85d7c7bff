"""A network for each group of observations, joined by hidden layers: the policy of SM 1.4."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape
from ddco_pyro.model.networks.numpy_form import NumpyForm, joined, numpy_form, perceptrons
from ddco_pyro.model.networks.stacked import Perceptrons, options_first, options_last
from ddco_pyro.model.networks.state import State, Trunk, answer, initial_state
from ddco_pyro.spec import Activation


class Branches(nn.Module):
    """K perceptrons over what several networks give, side by side; the state is theirs, one after another."""

    def __init__(
        self,
        shape: InputShape,
        outputs: int | None,
        copies: int,
        hidden: tuple[int, ...],
        dropout: float,
        activation: Activation,
        of: Mapping[str, Trunk],
    ) -> None:
        super().__init__()
        self.names = tuple(of)
        self.of = nn.ModuleList(trunk.network for trunk in of.values())
        features = sum(trunk.features for trunk in of.values())
        self.layers = Perceptrons(copies, features, hidden, outputs, dropout, activation)
        self.features = self.layers.features

    def initial_state(self, trajectories: int) -> State:
        """The states of the branches."""
        return tuple(tensor for branch in self.of for tensor in initial_state(branch, trajectories))

    def forward(self, inputs: Inputs, state: State | None = None) -> tuple[Tensor, State]:
        """[N, T, K, outputs], and the state after the last step."""
        state = self.initial_state(inputs.batch[0]) if state is None else state
        values: list[Tensor] = []
        after: State = ()
        for branch in self.of:
            features, own = answer(branch, inputs, state[len(after) :][: len(initial_state(branch, 1))])
            values.append(options_first(features))
            after = (*after, *own)
        return options_last(self.layers(torch.cat(values, -1)), inputs.batch), after

    def numpy_form(self) -> NumpyForm | None:
        """What the numpy runner has to know of it."""
        forms = [form for branch in self.of if (form := numpy_form(branch)) is not None]
        return perceptrons(self.layers, joined(forms)) if len(forms) == len(self.of) else None
