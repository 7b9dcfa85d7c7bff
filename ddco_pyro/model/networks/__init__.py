"""The networks a spec can name; ``build`` makes one, or imports a user's own ``module:Class``."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

from torch import nn

from ddco_pyro.model.networks.conv import Conv
from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.lstm import Lstm
from ddco_pyro.model.networks.mlp import Linear, Mlp
from ddco_pyro.model.networks.options import checked_options
from ddco_pyro.model.networks.per_timestep import PerTimestep
from ddco_pyro.model.networks.state import Trunk
from ddco_pyro.model.networks.trial import try_network
from ddco_pyro.spec import NetworkSpec

__all__ = ["CLASSES", "InputShape", "Inputs", "ShapeError", "build"]

CLASSES: dict[str, type[nn.Module]] = {
    "linear": Linear,
    "mlp": Mlp,
    "per_timestep": PerTimestep,
    "conv": Conv,
    "lstm": Lstm,
}
"""The built-in networks by name. Their settings, as a spec has them, are those of :mod:`ddco_pyro.spec.networks`."""


def build(spec: NetworkSpec, shape: InputShape, outputs: int, copies: int) -> nn.Module:
    """``copies`` independent networks that map :class:`Inputs` to [N, T, copies, outputs].

    Each is made as ``Class(shape, outputs, copies, **settings)``, a user's too, which is also tried. One that
    remembers is a :class:`~ddco_pyro.model.networks.state.HasState`.

    :raises ShapeError: where the network cannot read these observations, cannot be imported or made, or is refused by
        :func:`ddco_pyro.model.networks.trial.try_network`.
    :raises SpecError: where the options do not fit the signature of a user's class.
    """
    return _read(spec, shape, outputs, copies)


def build_trunk(spec: NetworkSpec, shape: InputShape, copies: int) -> Trunk:
    """``copies`` independent networks for others to read: a built-in one without its last layer, or a user's with
    ``features`` outputs.

    :raises ShapeError: as :func:`build`.
    :raises SpecError: as :func:`build`.
    """
    if spec.network not in CLASSES:
        return Trunk(build(spec, shape, spec.features, copies), spec.features)
    network = _read(spec, shape, None, copies)
    return Trunk(network, network.features)  # type: ignore[arg-type]


def _read(spec: NetworkSpec, shape: InputShape, outputs: int | None, copies: int) -> nn.Module:
    """A network of the observations that it is to read."""
    if spec.inputs:
        shape = shape.select(spec.inputs)
    network = _built(spec, shape, outputs, copies)
    if spec.inputs:
        network.register_forward_pre_hook(partial(_select, spec.inputs))
    return network


def _select(names: Sequence[str], network: nn.Module, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """A network that is to read some observations is given no others."""
    return (arguments[0].select(names), *arguments[1:])


def _built(spec: NetworkSpec, shape: InputShape, outputs: int | None, copies: int) -> nn.Module:
    if spec.network in CLASSES:
        settings = {
            key: build_trunk(value, shape, copies) if isinstance(value, NetworkSpec) else value
            for key, value in spec.settings.items()
        }
        return CLASSES[spec.network](shape, outputs, copies, **settings)
    assert outputs is not None  # a user's network always has some
    network_class = _imported(spec.network)
    options = checked_options(network_class, spec.settings)
    try:
        network = network_class(shape, outputs, copies, **options)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {spec.network!r} cannot be made with options {spec.options}: {error}") from error
    try_network(spec.network, network, shape, (copies, outputs))
    return network


def _imported(name: str) -> type[nn.Module]:
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {name!r} cannot be imported: {error}") from error
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise ShapeError(f"network {name!r} is not a torch.nn.Module class")
    return found
