"""How a network says what the numpy runner of an exported controller has to know of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from torch import nn

from ddco_pyro.model.networks.stacked import Perceptrons, StackedLinear

NumpyForm = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts for ``controller.json`` and arrays for ``weights.npz``: a tree whose nodes have a ``kind``, each a method of
:class:`ddco_pyro.exporting.runner.NumpyNetworks`, and read what ``of`` gives; the arrays of ``of`` are
``of.<name>``."""


@runtime_checkable
class HasNumpyForm(Protocol):
    """A network that the numpy runner can evaluate."""

    def numpy_form(self) -> NumpyForm | None:
        """The facts and arrays; None where a network within it has none."""


def numpy_form(network: nn.Module) -> NumpyForm | None:
    """The form of any network; None where it has none."""
    return network.numpy_form() if isinstance(network, HasNumpyForm) else None


def vectors(keys: Sequence[str], copies: int) -> NumpyForm:
    """The form of these vectors side by side, for each of K copies."""
    return {"kind": "vectors", "keys": list(keys), "copies": copies}, {}


def perceptrons(layers: Perceptrons, of: NumpyForm) -> NumpyForm:
    """The form of K stacked perceptrons over something; its activation follows the first ``hidden`` layers."""
    linear = [layer for layer in layers if isinstance(layer, StackedLinear)]
    facts = {"kind": "perceptrons", "layers": len(linear), "hidden": layers.hidden, "activation": layers.activation}
    facts |= {"copies": layers.copies, "steps": 1}
    return over_layers(of, facts, {str(number): layer for number, layer in enumerate(linear)})


def over_layers(of: NumpyForm, facts: Mapping[str, Any], layers: Mapping[str, nn.Module]) -> NumpyForm:
    """The form of layers, by name, that read what another form gives."""
    return {**facts, "of": of[0]}, arrays_of(layers) | _within("of", of[1])


def joined(forms: Sequence[NumpyForm]) -> NumpyForm:
    """The form of what several give, side by side."""
    arrays: dict[str, np.ndarray] = {}
    for number, (_, own) in enumerate(forms):
        arrays |= _within(str(number), own)
    return {"kind": "joined", "of": [facts for facts, _ in forms]}, arrays


def arrays_of(layers: Mapping[str, nn.Module]) -> dict[str, np.ndarray]:
    """The parameters of layers, as ``<layer>.<parameter>``."""
    return {
        f"{name}.{key}": parameter.detach().numpy()
        for name, layer in layers.items()
        for key, parameter in layer.named_parameters()
    }


def _within(name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"{name}.{key}": array for key, array in arrays.items()}
