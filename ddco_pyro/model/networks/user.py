"""A user's network, ``module:Class``: imported, made, tried, and adapted to the built-in ones."""

from __future__ import annotations

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any, Self

from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.perceptrons import Network, State
from ddco_pyro.model.networks.probe import try_network

FEATURES = 64
"""Outputs of each copy of a class that is read as a trunk and has no attribute ``features``."""


class UserNetwork(Network):
    """A user's module as a :class:`Network`.

    The module maps :class:`Inputs` to [N, T, copies, outputs]. One with ``initial_state(N)`` is called with
    inputs and a state, and gives outputs and the state after them.
    """

    def __init__(self, module: nn.Module, outputs: int, copies: int) -> None:
        super().__init__()
        self.module, self.copies, self.outputs = module, copies, outputs
        self.remembers = hasattr(module, "initial_state")

    @classmethod
    def made(
        cls, name: str, shape: InputShape, outputs: int | None, copies: int, options: Mapping[str, Any]
    ) -> Self:
        """The network of the class ``name``, tried on random observations.

        :param outputs: None for a trunk, whose class says their number as ``features``.
        :raises ShapeError: the class cannot be imported or made, or :func:`try_network` refuses it.
        """
        network_class = _imported(name)
        outputs = getattr(network_class, "features", FEATURES) if outputs is None else outputs
        try:
            module = network_class(shape, outputs, copies, **options)
        except Exception as error:  # whatever the user's code raises
            why = " ".join(str(error).split())
            known = f"network {name!r} cannot be made with options {dict(options)}"
            raise ShapeError(f"{known}: {why}") from error
        network = cls(module, outputs, copies)
        try_network(name, network, shape)
        return network

    @property
    def features(self) -> int:
        return self.outputs

    def initial_state(self, trajectories: int) -> State:
        return self.module.initial_state(trajectories) if self.remembers else ()  # type: ignore[operator, no-any-return]

    def forward(self, inputs: Inputs, state: State = ()) -> tuple[Tensor, State]:
        return self.module(inputs, state) if self.remembers else (self.module(inputs), state)

    def begin_at(self, outputs: int, value: float = 0.0) -> None:
        """Nothing: a user's outputs start where the module's own weights put them."""


def _imported(name: str) -> type[nn.Module]:
    try:
        network_class: Any = resolve_name(name)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {name!r} cannot be imported: {error}") from error
    if not (isinstance(network_class, type) and issubclass(network_class, nn.Module)):
        raise ShapeError(f"network {name!r} is not a torch.nn.Module class")
    return network_class
