"""What the numpy runner of an exported controller has to know of a network: facts and arrays.

A form is a tree. Each node has a ``kind``, a method of :class:`ddco_pyro.exporting.runner.NumpyNetworks`, and
reads what its ``of`` gives. The arrays of ``of`` are called ``of.<name>``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import nn

NumpyForm = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Facts for ``controller.json``, and arrays for ``weights.npz``."""


def vectors(keys: Sequence[str], copies: int) -> NumpyForm:
    """The form of these vectors side by side, for each of K copies."""
    return {"kind": "vectors", "keys": list(keys), "copies": copies}, {}


def over_layers(of: NumpyForm, facts: Mapping[str, Any], layers: Mapping[str, nn.Module]) -> NumpyForm:
    """The form of layers, by name, that read what another form gives."""
    return {**facts, "of": of[0]}, arrays_of(layers) | _within("of", of[1])


def joined(forms: Sequence[NumpyForm]) -> NumpyForm:
    """The form of what several forms give, side by side."""
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
