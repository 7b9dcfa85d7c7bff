"""One step of an exported controller as a module for ONNX, and its description for the numpy runner."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.exporting.runner import ARRAY
from ddco_pyro.model.emissions import KINDS
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.outputs import TERMINATION_BOUND, Outputs
from ddco_pyro.spec import STEP, ObservationSpec, RolloutSpec


def named(outputs: Outputs) -> dict[str, Tensor]:
    """Network outputs by the names of the runner, each [N, T, ...].

    ``selection_d``: log-probabilities [K, 1 + k]. ``control_d``: the numbers of the control [K, size]. Both
    belong to the callers of level d, of which the last is the meta-policy. ``termination_d``: ψ [k].
    """
    tensors = dict[str, Tensor | None]()
    tensors |= {f"termination_{d}": log[..., 1].double().exp() for d, log in enumerate(outputs.termination)}
    for level, caller in enumerate(outputs.callers):
        tensors |= {f"selection_{level}": caller.selection, f"control_{level}": caller.numbers}
    return {name: tensor for name, tensor in tensors.items() if tensor is not None}


class StepProgram(nn.Module):
    """Maps features [F] (float64, not standardised), step [1], images [H, W, C], state to outputs and state.

    ``names`` are those of :func:`named`. The state holds tensors [1, ...] of each recurrent network, in the
    order of :meth:`~ddco_pyro.model.hierarchy.Hierarchy.networks`.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        super().__init__()
        self.hierarchy = hierarchy
        self.keys = list(hierarchy.encoder.images)
        with torch.no_grad():
            self.state = hierarchy.initial_states(1)
            self.names = list(self.outputs(*self.example())[0])

    def outputs(
        self, features: Tensor, step: Tensor, *rest: Tensor
    ) -> tuple[dict[str, Tensor], list[Tensor]]:
        """The outputs by name, and the next state."""
        images, tensors = rest[: len(self.keys)], iter(rest[len(self.keys) :])
        states = {name: tuple(next(tensors) for _ in state) for name, state in self.state.items()}
        vectors = self.hierarchy.encoder.standardized(features.reshape(1, 1, -1))
        pairs = zip(self.keys, images, strict=True)
        pictures = {key: image.reshape(1, 1, *image.shape) for key, image in pairs}
        outputs, states = self.hierarchy.advance(Inputs(vectors, pictures, step), states)
        at_step = {name: values[0, 0] for name, values in named(outputs).items()}
        return at_step, [tensor for state in states.values() for tensor in state]

    def forward(self, features: Tensor, step: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """The outputs, in the order of ``names``, and the next state."""
        outputs, state = self.outputs(features, step, *rest)
        return (*outputs.values(), *state)

    def initial_state(self) -> list[Tensor]:
        """The state before the first step."""
        return [tensor.detach() for state in self.state.values() for tensor in state]

    def example(self) -> tuple[Tensor, ...]:
        """Inputs of the right shapes."""
        encoder = self.hierarchy.encoder
        images = [torch.zeros(shape, dtype=torch.uint8) for shape in encoder.images.values()]
        features = torch.zeros(sum(encoder.given), dtype=torch.float64)
        return (features, torch.zeros(1, dtype=torch.int64), *images, *self.initial_state())

    def onnx_names(self) -> tuple[list[str], list[str]]:
        """The names of inputs and outputs in ONNX."""
        images = [f"image_{number}" for number in range(len(self.keys))]
        state = [f"state_{number}" for number in range(len(self.initial_state()))]
        return ["features", "step", *images, *state], [*self.names, *(f"next_{name}" for name in state)]


def describe(hierarchy: Hierarchy, control: RolloutSpec, program: StepProgram) -> dict[str, Any]:
    """The controller for its runner, a tree of facts and arrays.

    ``networks`` is None where numpy cannot evaluate every network.
    """
    encoder = hierarchy.encoder
    vectors = {spec.name: spec for spec in encoder.specs}
    scaling = hierarchy.scaling
    scale, shift = scaling.scale.numpy(), scaling.shift.numpy()
    return {
        "networks": _networks(hierarchy),
        "callers": [
            {
                "logits": caller.sizes[0],
                "choices": caller.options,
                "hybrid": caller.emits_control and caller.emits_options,
            }
            for caller in hierarchy.named_callers().values()
        ],
        "outputs": program.names,
        "state": [
            {"kind": str(part.dtype), "shape": list(part.shape), "values": part.ravel().tolist()}
            for part in (tensor.numpy() for tensor in program.initial_state())
        ],
        "observations": [
            {
                "key": spec.key,
                "minus": spec.minus,
                "shape": list(encoder.shapes.get(spec.key, (1,))),
                "image": spec.key in encoder.images,
                "differences": spec.differences,
                "angles": list(spec.angles),
                "quaternions": list(spec.quaternions),
                **(encoder.transforms[spec.key].as_data() if spec.key in encoder.images else {}),
            }
            for spec in [*encoder.specs, *(ObservationSpec(key=key) for key in encoder.images)]
        ],
        "step": {"key": STEP, "longest": float(encoder.longest)} if STEP in vectors else None,
        "features": dict(zip(encoder.keys, encoder.sizes, strict=True)),
        "levels": [level.count for level in hierarchy.option_levels()],
        "relative_to": scaling.relative_to,
        "varying": scaling.varying.tolist(),
        "scale": scale.tolist(),
        "shift": shift.tolist(),
        "control": control.control,
        "options": control.options,
        "constant": [float(value) for value in scaling.emitted(torch.zeros(len(scaling.varying)))],
        "parts": [_part(hierarchy, number) for number in range(len(scaling.parts))],
        "termination_bound": TERMINATION_BOUND,
    }


def _part(hierarchy: Hierarchy, number: int) -> dict[str, Any]:
    """The description of one part of the control.

    ``std`` has σ and other parameters of each level's callers, lowest first; callers that emit no control
    have none. A σ that depends on the state is floor + softplus(y + start). For each such dimension
    ``per_state`` holds its place in the part, the place of y among a caller's numbers, floor and start.
    """
    scaling = hierarchy.scaling
    part, places = scaling.parts[number], list(scaling.groups[number])
    before, callers = scaling.parts[:number], [*hierarchy.named_callers().values()]
    kind, first = KINDS[part.kind], sum(scaling.counts[:number])
    own = slice(first, first + scaling.counts[number])
    each = zip(callers, (*(level.count for level in hierarchy.option_levels()), 1), strict=True)
    stds = [(caller.std, k) for caller, k in each]
    std = [
        [] if one is None else one(torch.zeros(k, len(one.of_state)))[..., own].tolist() for one, k in stds
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


def _networks(hierarchy: Hierarchy) -> dict[str, Any] | None:
    """The scaling of features, and the form of each network; None where one has none."""
    levels = hierarchy.option_levels()
    callers = enumerate(hierarchy.named_callers().values())
    networks = {f"caller_{n}": caller.network for n, caller in callers}
    ends = enumerate(level.termination for level in levels)
    networks |= {f"end_{n}": end for n, end in ends if end is not None}
    networks |= {} if hierarchy.trunk is None else {"trunk": hierarchy.trunk}
    forms = {name: network.numpy_form() for name, network in networks.items()}
    encoder = hierarchy.encoder
    scaling = {"mean": encoder.mean, "deviation": encoder.std}
    if encoder.has_bins:
        scaling |= {"low": encoder.low, "high": encoder.high, "places": encoder.places}
    return None if None in forms.values() else forms | {key: own.numpy() for key, own in scaling.items()}


def without_arrays(node: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """A tree with each array's name in its place; ``arrays`` gets them, named by places below ``name``."""
    if isinstance(node, np.ndarray):
        arrays[name] = node
        return {ARRAY: name}
    if isinstance(node, Mapping):
        return {key: without_arrays(own, f"{name}.{key}".lstrip("."), arrays) for key, own in node.items()}
    if isinstance(node, list):
        return [without_arrays(own, f"{name}.{number}", arrays) for number, own in enumerate(node)]
    return node
