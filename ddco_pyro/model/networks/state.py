"""What a network remembers of the observations before: given to it with each call, and given back by it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol, runtime_checkable

from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs

State = tuple[Tensor, ...]
"""Tensors [N, ...], of each trajectory its own."""

States = Mapping[str, State]
"""The states of several networks by name."""


@runtime_checkable
class HasState(Protocol):
    """A network that remembers: it is called with inputs and a state, and gives outputs and the state after them.

    A call on T steps has to give what T calls on one step each give, with the state carried from each to the next.
    """

    def initial_state(self, trajectories: int) -> State:
        """The state before the first step of N trajectories."""


class Trunk(NamedTuple):
    """A network whose outputs [N, T, K, features] are read by another."""

    network: nn.Module
    features: int


def initial_state(network: nn.Module, trajectories: int) -> State:
    """The state of any network before the first step; nothing where it has none."""
    return network.initial_state(trajectories) if isinstance(network, HasState) else ()


def answer(network: nn.Module, inputs: Inputs | Tensor, state: State | None = None) -> tuple[Tensor, State]:
    """The outputs of any network [N, T, K, outputs], and its state after them.

    :param inputs: for a head the features of its trunk, [N, T, K, features].
    :param state: that after the steps before; None for the first step.
    """
    if isinstance(inputs, Tensor) or not isinstance(network, HasState):
        return network(inputs), ()
    said: tuple[Tensor, State] = network(inputs, initial_state(network, inputs.batch[0]) if state is None else state)
    return said


class Carried:
    """The states of several networks, by name, ``before`` the steps at hand and ``after`` them."""

    def __init__(self, before: States | None) -> None:
        self.before = before or {}
        self.after: dict[str, State] = {}

    def answer(self, name: str, network: nn.Module, inputs: Inputs | Tensor) -> Tensor:
        """The outputs of the network of this name."""
        outputs, state = answer(network, inputs, self.before.get(name))
        if isinstance(network, HasState):
            self.after[name] = state
        return outputs
