"""One step of all networks as a module that ``torch.export`` and ONNX can hold."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.outputs import Outputs


def named(outputs: Outputs) -> dict[str, Tensor]:
    """Network outputs by the names of the runner, each [N, T, ...].

    ``selection_d``: log-probabilities [K, 1 + k]. ``control_d``: the numbers of the control [K, size]. Both belong to
    the callers of level d, of which the last is the meta-policy. ``termination_d``: ψ [k].
    """
    tensors: dict[str, Tensor | None] = {
        f"termination_{d}": log[..., 1].double().exp() for d, log in enumerate(outputs.termination)
    }
    for level, caller in enumerate(outputs.callers):
        tensors |= {f"selection_{level}": caller.selection, f"control_{level}": caller.numbers}
    return {name: tensor for name, tensor in tensors.items() if tensor is not None}


class StepProgram(nn.Module):
    """Maps features [F] (float64, not standardised), step [1], images [H, W, C] and the state to outputs and state.

    ``names`` are those of :func:`named`. The state holds tensors [1, ...] of each recurrent network, in the order of
    :meth:`~ddco_pyro.model.hierarchy.Hierarchy.networks`.
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        super().__init__()
        self.hierarchy = hierarchy
        self.keys = list(hierarchy.encoder.images)
        with torch.no_grad():
            self.state = hierarchy.initial_states(1)
            self.names = list(self.outputs(*self.example())[0])

    def outputs(self, features: Tensor, step: Tensor, *rest: Tensor) -> tuple[dict[str, Tensor], list[Tensor]]:
        """The outputs by name, and the next state."""
        images, tensors = rest[: len(self.keys)], iter(rest[len(self.keys) :])
        states = {name: tuple(next(tensors) for _ in state) for name, state in self.state.items()}
        vectors = self.hierarchy.encoder.standardized(features.reshape(1, 1, -1))
        pictures = {key: image.reshape(1, 1, *image.shape) for key, image in zip(self.keys, images, strict=True)}
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
