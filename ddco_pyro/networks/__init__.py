"""The networks a spec can name; ``build`` makes one, or imports a user's own ``module:Class``."""

from __future__ import annotations

import importlib

from torch import nn

from ddco_pyro.networks.conv import Conv
from ddco_pyro.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.networks.mlp import Mlp
from ddco_pyro.networks.per_timestep import PerTimestep
from ddco_pyro.networks.trial import try_network
from ddco_pyro.spec import NetworkSpec

__all__ = ["InputShape", "Inputs", "ShapeError", "build"]


def build(spec: NetworkSpec, shape: InputShape, outputs: int, copies: int) -> nn.Module:
    """``copies`` independent networks that map :class:`Inputs` to [N, T, copies, outputs].

    A user's ``module:Class`` is called as ``Class(shape, outputs, copies, **options)``, and tried.

    :raises ShapeError: where the network cannot read these observations, cannot be imported or made, or is
        refused by :func:`ddco_pyro.networks.trial.try_network`.
    """
    if spec.network == "linear":
        return Mlp(shape, outputs, copies, hidden=())
    if spec.network == "mlp":
        return Mlp(shape, outputs, copies, spec.hidden, spec.dropout)
    if spec.network == "per_timestep":
        return PerTimestep(shape, outputs, copies, spec.hidden, spec.dropout)
    if spec.network == "conv":
        return Conv(shape, outputs, copies, spec.hidden, spec.dropout, spec.filters, spec.kernel)
    own = _own(spec.network)
    try:
        network = own(shape, outputs, copies, **spec.options)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {spec.network!r} cannot be made with options {spec.options}: {error}") from error
    try_network(spec.network, network, shape, (copies, outputs))
    return network


def _own(name: str) -> type[nn.Module]:
    module, _, attribute = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute)
    except Exception as error:  # whatever the user's code raises
        raise ShapeError(f"network {name!r} cannot be imported: {error}") from error
    if not (isinstance(found, type) and issubclass(found, nn.Module)):
        raise ShapeError(f"network {name!r} is not a torch.nn.Module class")
    return found
