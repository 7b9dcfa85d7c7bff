"""The networks that a spec can name, made by :func:`build`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from ddco_pyro.model.networks.conv import Conv
from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.lstm import Lstm
from ddco_pyro.model.networks.perceptrons import Branches, Constant, Mlp, Network, PerTimestep, State, States
from ddco_pyro.model.networks.user import UserNetwork
from ddco_pyro.spec import NetworkSpec
from ddco_pyro.spec.networks import UserNetworkSpec

CLASSES: dict[str, type[Network]] = {
    "linear": Mlp,
    "constant": Constant,
    "mlp": Mlp,
    "per_timestep": PerTimestep,
    "conv": Conv,
    "lstm": Lstm,
    "branches": Branches,
}
"""The built-in networks by name, each made as ``Class(shape, copies, **settings)``. The settings, as a spec
has them, are those of :mod:`ddco_pyro.spec.networks`."""


def build(spec: NetworkSpec, shape: InputShape, outputs: int | None, copies: int) -> Network:
    """``copies`` independent networks that give ``outputs`` numbers; None for a trunk, which others read.

    A network with ``inputs`` is given no other observations.

    :param shape: of the observations.
    :raises ShapeError: the network cannot read these observations, cannot be imported or made, or is refused
        by :func:`ddco_pyro.model.networks.probe.try_network`.
    """
    settings, seen = dict(spec.settings), shape.select(spec.inputs) if spec.inputs else shape
    if isinstance(spec, UserNetworkSpec):
        network: Network = UserNetwork.made(spec.network, seen, outputs, copies, settings)
    else:
        if settings.get("over"):
            with named("over"):
                settings["over"] = build(settings["over"], seen, None, copies)
        if "of" in settings:
            branches = settings["of"].items()
            settings["of"] = {name: _branch(name, branch, seen, copies) for name, branch in branches}
        network = CLASSES[spec.network](seen, copies, **settings)
        network = network if outputs is None else network.add_head(outputs)
    if spec.inputs:
        network.register_forward_pre_hook(partial(_select, spec.inputs))
    return network


def _branch(name: str, spec: NetworkSpec, shape: InputShape, copies: int) -> Network:
    """A branch reads the observation that it is named after, or those in its ``inputs``."""
    with named(f"of.{name}"):
        return build(spec.model_copy(update={"inputs": spec.inputs or (name,)}), shape, None, copies)


def _select(names: Sequence[str], network: Network, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    return (arguments[0].select(names), *arguments[1:])


@contextmanager
def named(place: str) -> Iterator[None]:
    """Errors about a network begin with its place in the spec."""
    try:
        yield
    except ShapeError as error:
        raise ShapeError(f"{place}: {error}") from error
