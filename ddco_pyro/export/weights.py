"""The weights of a hierarchy as numpy arrays, and what the runner has to know of each network."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import nn

from ddco_pyro.hierarchy import Hierarchy
from ddco_pyro.networks.conv import POOLED, Conv
from ddco_pyro.networks.mlp import Mlp
from ddco_pyro.networks.per_timestep import PerTimestep
from ddco_pyro.networks.stacked import StackedLinear

Arrays = dict[str, np.ndarray]


def weights_and_networks(hierarchy: Hierarchy) -> tuple[Arrays, dict[str, Any]]:
    """Every array by name; ``callers``, ``terminations`` and whether ``numpy`` can evaluate all of them."""
    encoder, scaling = hierarchy.encoder, hierarchy.scaling
    arrays: Arrays = {"mean": encoder.mean.numpy(), "deviation": encoder.std.numpy()}
    arrays |= {"scale": scaling.scale.numpy(), "shift": scaling.shift.numpy()}
    arrays |= {"constant": scaling.constant.numpy(), "order": scaling.order.numpy()}
    levels = hierarchy.option_levels()
    networks = {f"caller_{number}": one.network for number, one in enumerate(hierarchy.callers())}
    networks |= {f"end_{number}": one.termination for number, one in enumerate(levels)}
    known = all(isinstance(one, Mlp | PerTimestep | Conv) for one in networks.values())
    facts = {name: _describe(one, name, arrays) for name, one in networks.items()} if known else {}
    callers = [
        {
            "network": facts.get(f"caller_{number}"),
            "logits": one.sizes[0],
            "choices": one.options,
            "hybrid": one.emits_control and one.emits_options,
        }
        for number, one in enumerate(hierarchy.callers())
    ]
    terminations = [facts.get(f"end_{number}") for number in range(len(levels))]
    return arrays, {"callers": callers, "terminations": terminations, "numpy": known}


def _describe(network: nn.Module, name: str, arrays: Arrays) -> dict[str, Any]:
    """What kind of network it is; its weights go into ``arrays``."""
    assert isinstance(network, Mlp | PerTimestep | Conv)
    layers = [one for one in network.layers if isinstance(one, StackedLinear)]
    for number, layer in enumerate(layers):
        arrays[f"{name}.{number}.weight"] = layer.weight.detach().numpy()
        arrays[f"{name}.{number}.bias"] = layer.bias.detach().numpy()
    found: dict[str, Any] = {"network": "mlp", "layers": len(layers), "copies": len(layers[0].weight)}
    if isinstance(network, PerTimestep):
        return found | {"network": "per_timestep", "copies": network.copies, "steps": network.steps}
    if isinstance(network, Conv):
        for key, one in network.convolutions.items():
            assert isinstance(one, nn.Conv2d)
            assert one.bias is not None
            arrays[f"{name}.{key}.weight"] = one.weight.detach().numpy()
            arrays[f"{name}.{key}.bias"] = one.bias.detach().numpy()
        return found | {"network": "conv", "images": list(network.convolutions), "pooled": POOLED}
    return found
