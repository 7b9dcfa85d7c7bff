"""What a network remembers of the observations before: given to it with each call, and given back by it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, TypeGuard

from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs

State = tuple[Tensor, ...]
"""Tensors [N, ...], of each trajectory its own."""

States = Mapping[str, State]
"""The states of several networks by name."""


class HasState(Protocol):
    """A network that remembers: it is called with inputs and a state, and gives outputs and the state after them.

    A call on T steps has to give what T calls on one step each give, with the state carried from each to the next.
    """

    def initial_state(self, trajectories: int) -> State:
        """The state before the first step of N trajectories."""
        ...

    def __call__(self, inputs: Inputs, state: State) -> tuple[Tensor, State]:
        """The outputs [N, T, K, outputs], and the state after them."""
        ...


class Trunk(NamedTuple):
    """A network whose outputs [N, T, K, features] are read by another; K is 1 where all options read the same."""

    network: nn.Module
    features: int
    copies: int


def remembers(network: Any) -> TypeGuard[HasState]:
    """Whether a network has a state; asked at every call, for which ``isinstance`` of a protocol is too slow."""
    return hasattr(network, "initial_state")


def initial_state(network: nn.Module, trajectories: int) -> State:
    """The state of any network before the first step; nothing where it has none."""
    return network.initial_state(trajectories) if remembers(network) else ()


def answer(network: nn.Module, inputs: Inputs | Tensor, state: State | None = None) -> tuple[Tensor, State]:
    """The outputs of any network [N, T, K, outputs], and its state after them.

    :param inputs: for a head the features of its trunk, [N, T, K, features].
    :param state: that after the steps before; None for the first step.
    """
    if isinstance(inputs, Tensor) or not remembers(network):
        return network(inputs), ()
    return network(inputs, network.initial_state(inputs.batch[0]) if state is None else state)


class Carried:
    """The states of several networks, by name, ``before`` the steps at hand and ``after`` them."""

    def __init__(self, before: States | None) -> None:
        self.before = before or {}
        self.after: dict[str, State] = {}

    def answer(self, name: str, network: nn.Module, inputs: Inputs | Tensor) -> Tensor:
        """The outputs of the network of this name."""
        outputs, state = answer(network, inputs, self.before.get(name))
        if remembers(network):
            self.after[name] = state
        return outputs
