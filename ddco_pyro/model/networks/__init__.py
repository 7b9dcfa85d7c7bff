"""The networks a spec can name; ``build`` makes one, or imports a user's own ``module:Class``."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import nn

from ddco_pyro.model.networks.branches import Branches
from ddco_pyro.model.networks.conv import Conv
from ddco_pyro.model.networks.head import Head
from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.lstm import Lstm
from ddco_pyro.model.networks.mlp import Linear, Mlp
from ddco_pyro.model.networks.options import checked_options
from ddco_pyro.model.networks.per_timestep import PerTimestep
from ddco_pyro.model.networks.shared import Shared
from ddco_pyro.model.networks.state import Trunk
from ddco_pyro.model.networks.trial import try_network
from ddco_pyro.spec import NetworkSpec, SpecError
from ddco_pyro.spec.networks import UserNetworkSpec

__all__ = ["CLASSES", "InputShape", "Inputs", "ShapeError", "begin_at_zero", "build", "build_trunk", "named"]

CLASSES: dict[str, type[nn.Module]] = {
    "linear": Linear,
    "mlp": Mlp,
    "per_timestep": PerTimestep,
    "conv": Conv,
    "lstm": Lstm,
    "branches": Branches,
}
"""The built-in networks by name. Their settings, as a spec has them, are those of :mod:`ddco_pyro.spec.networks`."""


def build(spec: NetworkSpec, shape: InputShape | Trunk, outputs: int, copies: int) -> nn.Module:
    """``copies`` independent networks that map :class:`Inputs`, or the features of a trunk, to [N, T, copies, outputs].

    Each is made as ``Class(shape, outputs, copies, **settings)``, a user's too, which is also tried. One that
    remembers is a :class:`~ddco_pyro.model.networks.state.HasState`.

    :raises ShapeError: where the network cannot read these observations, cannot be imported or made, is to be shared,
        or is refused by :func:`ddco_pyro.model.networks.trial.try_network`.
    :raises SpecError: where the options do not fit the signature of a user's class.
    """
    if spec.shared:
        raise ShapeError("shared: options would all do the same; share a trunk, or a network in of or over")
    if isinstance(shape, Trunk):
        return Head(shape, outputs, copies, **spec.settings)
    return _read(spec, shape, outputs, copies)


def begin_at_zero(network: nn.Module, outputs: int) -> None:
    """Have the last so many outputs of a built-in network start at 0; a user's start where its own weights put them."""
    if isinstance(network, (*CLASSES.values(), Head)):
        with torch.no_grad():
            for parameter in network.layers[-1].parameters():  # type: ignore[index, union-attr]
                parameter[..., -outputs:] = 0


def build_trunk(spec: NetworkSpec, shape: InputShape | Trunk, copies: int) -> Trunk:
    """``copies`` independent networks for others to read, or a ``shared`` one: a built-in one without its last layer,
    or a user's with ``features`` outputs.

    :param shape: of the observations, or another trunk, which it reads in their place.

    :raises ShapeError: as :func:`build`.
    :raises SpecError: as :func:`build`.
    """
    if isinstance(shape, Trunk):
        head = Head(shape, None, copies, **spec.settings)
        return Trunk(head, head.features, copies)
    if spec.shared:
        alone = build_trunk(spec.model_copy(update={"shared": False}), shape, 1)
        return Trunk(Shared(alone.network, copies), alone.features, copies)
    if isinstance(spec, UserNetworkSpec):
        return Trunk(build(spec, shape, spec.features, copies), spec.features, copies)
    network = _read(spec, shape, None, copies)
    return Trunk(network, network.features, copies)  # type: ignore[arg-type]


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
        settings = spec.settings
        if settings.get("over"):
            with named("over"):
                settings["over"] = build_trunk(settings["over"], shape, copies)
        if "of" in settings:
            settings["of"] = {name: _branch(name, branch, shape, copies) for name, branch in settings["of"].items()}
        return CLASSES[spec.network](shape, outputs, copies, **settings)
    assert outputs is not None  # a user's network always has some
    assert isinstance(spec, UserNetworkSpec)
    network_class = _imported(spec.network)
    options = checked_options(network_class, spec.settings)
    try:
        network = network_class(shape, outputs, copies, **options)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {spec.network!r} cannot be made with options {spec.options}: {error}") from error
    try_network(spec.network, network, shape, (copies, outputs))
    return network


def _branch(name: str, spec: NetworkSpec, shape: InputShape, copies: int) -> Trunk:
    """A branch reads the observation that it is named after, unless it is told which."""
    with named(f"of.{name}"):
        return build_trunk(spec.model_copy(update={"inputs": spec.inputs or (name,)}), shape, copies)


@contextmanager
def named(place: str) -> Iterator[None]:
    """Errors about a network say where in the spec it stands."""
    try:
        yield
    except SpecError as error:
        raise SpecError(*(f"{place}.{problem}" for problem in error.problems)) from error
    except ShapeError as error:
        raise ShapeError(f"{place}: {error}") from error


def _imported(name: str) -> type[nn.Module]:
    module, _, attribute = name.partition(":")
    try:
        network_class = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {name!r} cannot be imported: {error}") from error
    if not (isinstance(network_class, type) and issubclass(network_class, nn.Module)):
        raise ShapeError(f"network {name!r} is not a torch.nn.Module class")
    return network_class
