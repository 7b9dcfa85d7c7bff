"""The networks a spec can name; ``build`` makes one, or imports a user's own ``module:Class``."""

from __future__ import annotations

import importlib

import torch
from torch import nn

from ddco_pyro.networks.conv import Conv
from ddco_pyro.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.networks.mlp import Mlp
from ddco_pyro.networks.per_timestep import PerTimestep
from ddco_pyro.spec import NetworkSpec

__all__ = ["InputShape", "Inputs", "ShapeError", "build"]


def build(spec: NetworkSpec, shape: InputShape, outputs: int, copies: int) -> nn.Module:
    """``copies`` independent networks that map :class:`Inputs` to [N, T, copies, outputs].

    A user's ``module:Class`` is called as ``Class(shape, outputs, copies, **options)``, and tried once.

    :raises ShapeError: where the network cannot read these observations, cannot be imported or made, or gives
        another shape.
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
    _try(spec.network, network, shape, (copies, outputs))
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


def _try(name: str, network: nn.Module, shape: InputShape, size: tuple[int, int]) -> None:
    """Run a user's network once, on observations that are 0.

    :raises ShapeError: it fails, or does not give [N, T, copies, outputs].
    """
    batch = (1, 2)
    images = {key: torch.zeros(*batch, *image, dtype=torch.uint8) for key, image in shape.images.items()}
    time = torch.arange(batch[1]).clamp(max=shape.steps - 1)  # it may have parameters for each step
    training = network.training
    network.eval()  # nothing it keeps track of is to change
    try:
        with torch.no_grad():
            found = network(Inputs(torch.zeros(*batch, shape.vector), images, time))
    except Exception as error:  # whatever the user's code raises
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ShapeError(f"network {name!r} fails for observations that are 0, N = 1, T = 2: {what}") from error
    finally:
        network.train(training)
    given = f"shape {list(found.shape)}" if isinstance(found, torch.Tensor) else f"a {type(found).__name__}"
    needed = [*batch, *size]
    if given != f"shape {needed}":
        raise ShapeError(
            f"network {name!r} gives {given}; it has to be a tensor [N, T, copies, outputs], here {needed}"
        )
