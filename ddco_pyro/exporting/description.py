"""Description of a controller for the numpy runner: ``controller.json`` and ``weights.npz``."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ddco_pyro.exporting.program import StepProgram
from ddco_pyro.model.emissions import KINDS
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import TERMINATION_BOUND
from ddco_pyro.spec import STEP, RolloutSpec

Arrays = dict[str, np.ndarray]


def describe(hierarchy: Hierarchy, control: RolloutSpec, program: StepProgram) -> tuple[dict[str, Any], Arrays]:
    """The contents of ``controller.json`` and ``weights.npz``.

    ``numpy`` says whether numpy can evaluate every network.
    """
    networks, weights = _networks(hierarchy)
    encoder = hierarchy.encoder
    vectors = {spec.key: spec for spec in encoder.specs}
    scaling = hierarchy.scaling
    scale, shift = scaling.scale.numpy(), scaling.shift.numpy()
    return networks | {
        "outputs": program.names,
        "state": [
            {"kind": str(part.dtype), "shape": list(part.shape), "values": part.ravel().tolist()}
            for part in (tensor.numpy() for tensor in program.initial_state())
        ],
        "observations": [
            {
                "key": key,
                "shape": list(shape),
                "image": key in encoder.images,
                "relative": key in vectors and vectors[key].relative,
                "differences": key in vectors and vectors[key].differences,
                "angles": list(vectors[key].angles) if key in vectors else [],
                "quaternions": list(vectors[key].quaternions) if key in vectors else [],
                **(encoder.transforms[key].as_data() if key in encoder.images else {}),
            }
            for key, shape in ((key, encoder.shapes.get(key, (1,))) for key in [*vectors, *encoder.images])
        ],
        "step": {"key": STEP, "longest": float(encoder.longest)} if STEP in vectors else None,
        "features": dict(zip(encoder.keys, encoder.sizes, strict=True)),
        "levels": [level.count for level in hierarchy.option_levels()],
        "varying": scaling.varying.tolist(),
        "scale": scale.tolist(),
        "shift": shift.tolist(),
        "control": control.control,
        "options": control.options,
        "constant": [float(value) for value in scaling.emitted(torch.zeros(len(scaling.varying)))],
        "parts": [_part(hierarchy, number) for number in range(len(scaling.parts))],
        "termination_bound": TERMINATION_BOUND,
    }, weights


def _part(hierarchy: Hierarchy, number: int) -> dict[str, Any]:
    """The description of one part of the control.

    ``std`` has σ and other parameters of each level's callers, lowest first; callers that emit no control have none. A
    σ that depends on the state is floor + softplus(y + start). For each such dimension ``per_state`` holds its place
    in the part, the place of y among a caller's numbers, floor and start.
    """
    scaling = hierarchy.scaling
    part, places = scaling.parts[number], list(scaling.groups[number])
    before, callers = scaling.parts[:number], hierarchy.callers()
    kind, first = KINDS[part.kind], sum(scaling.counts[:number])
    own = slice(first, first + scaling.counts[number])
    each = zip(callers, (*(level.count for level in hierarchy.option_levels()), 1), strict=True)
    std = [
        [] if one.std is None else one.std(torch.zeros(k, len(one.std.of_state)))[..., own].tolist() for one, k in each
    ]
    given = next(caller.std for caller in callers if caller.std is not None)  # all have the same kinds of σ
    per_state = [
        [at - first, scaling.numbers + number, float(given.floor[at]), float(given.start[at])]
        for number, at in enumerate(given.of_state)
        if first <= at < first + len(places)
    ]
    extra = len(scaling.varying) + sum(KINDS[other.kind].further_noise for other in before)
    ends = ([None if math.isinf(end) else end for end in values] for values in (part.low, part.high))
    return {
        "kind": part.kind,
        "dims": list(part.dims),
        "places": [*places, *range(extra, extra + kind.further_noise)],
        "size": kind.size(part),
        "values": list(part.values),
        "ends": list(ends),
        "shift": scaling.shift[places].tolist(),
        "scale": scaling.scale[places].tolist(),
        "std": std if part.continuous else [],
        "per_state": per_state if part.continuous else [],
    }


def _networks(hierarchy: Hierarchy) -> tuple[dict[str, Any], Arrays]:
    """The form of each network, and every array by name."""
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
    for name, (_, parameters) in forms.items():
        arrays |= {f"{name}.{key}": array for key, array in parameters.items()}
    callers = [
        {
            "logits": caller.sizes[0],
            "choices": caller.options,
            "hybrid": caller.emits_control and caller.emits_options,
        }
        for caller in hierarchy.callers()
    ]
    facts = {name: about for name, (about, _) in forms.items()}
    return {"networks": facts, "callers": callers, "numpy": len(forms) == len(networks)}, arrays
