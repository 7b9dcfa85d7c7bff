"""How a network says what the numpy runner of an exported controller has to know of it."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from torch import nn

from ddco_pyro.model.networks.stacked import StackedLinear

NumpyForm = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts for ``controller.json`` and arrays for ``weights.npz``, as :class:`ddco_pyro.export.runner.NumpyNetworks` takes
them: K perceptrons for each of ``steps``, over the vector and what convolutions make of ``images``."""


@runtime_checkable
class HasNumpyForm(Protocol):
    """A network that the numpy runner can evaluate."""

    def numpy_form(self) -> NumpyForm:
        """The facts and arrays."""


def perceptrons(layers: nn.Sequential) -> NumpyForm:
    """The form of K stacked perceptrons over the vector."""
    linear = [layer for layer in layers if isinstance(layer, StackedLinear)]
    arrays: dict[str, np.ndarray] = {}
    for number, layer in enumerate(linear):
        arrays |= arrays_of(layer, str(number))
    return {"layers": len(linear), "copies": len(linear[0].weight), "steps": 1, "images": []}, arrays


def arrays_of(layer: nn.Module, name: str) -> dict[str, np.ndarray]:
    """The parameters of one layer, by its name and theirs."""
    return {f"{name}.{key}": parameter.detach().numpy() for key, parameter in layer.named_parameters()}
