"""The weights of a hierarchy as numpy arrays, and what the runner has to know of each network."""

from __future__ import annotations

from typing import Any

import numpy as np

from ddco_pyro.model.hierarchy import Hierarchy

Arrays = dict[str, np.ndarray]


def weights_and_networks(hierarchy: Hierarchy) -> tuple[Arrays, dict[str, Any]]:
    """Every array by name; ``callers``, ``terminations``, ``trunks``, the hierarchy's ``trunk``, and whether ``numpy``
    can evaluate all of them.
    """
    encoder = hierarchy.encoder
    arrays: Arrays = {"mean": encoder.mean.numpy(), "deviation": encoder.std.numpy()}
    if encoder.has_bins:
        ends = {"low": encoder.low, "high": encoder.high, "places": encoder.places}
        arrays |= {name: array.numpy() for name, array in ends.items()}
    levels = hierarchy.option_levels()
    networks = {f"caller_{number}": caller.network for number, caller in enumerate(hierarchy.callers())}
    networks |= {f"end_{n}": level.termination for n, level in enumerate(levels) if level.termination is not None}
    networks |= {f"trunk_{number}": level.trunk for number, level in enumerate(levels) if level.trunk is not None}
    networks |= {} if hierarchy.trunk is None else {"trunk": hierarchy.trunk}
    forms = {name: form for name, network in networks.items() if (form := network.numpy_form()) is not None}
    facts = {name: about for name, (about, _) in forms.items()}
    arrays |= {f"{name}.{key}": array for name, (_, each) in forms.items() for key, array in each.items()}
    callers = [
        {
            "network": facts.get(f"caller_{number}"),
            "logits": caller.sizes[0],
            "choices": caller.options,
            "hybrid": caller.emits_control and caller.emits_options,
        }
        for number, caller in enumerate(hierarchy.callers())
    ]
    terminations = [facts.get(f"end_{number}") for number in range(len(levels))]
    trunks = [facts.get(f"trunk_{number}") for number in range(len(levels))]
    return arrays, {
        "callers": callers,
        "terminations": terminations,
        "trunks": trunks,
        "trunk": facts.get("trunk"),
        "numpy": len(forms) == len(networks),
    }
