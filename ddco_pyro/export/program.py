"""One step of all networks as a program without Python in it, for ``torch.export`` and ONNX."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.model.encoding import ObservationEncoder
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs


class StepProgram(nn.Module):
    """Features [F] (float64, not yet standardised), step [1] and images [H, W, C] to the outputs in ``names``.

    ``selection_d`` log-probabilities [K, 1 + k], ``control_d`` the numbers of the control [K, size], both of the
    callers of level d (the last is the meta-policy), and ``termination_d`` ψ [k].
    """

    def __init__(self, hierarchy: Hierarchy) -> None:
        super().__init__()
        self.hierarchy = hierarchy
        self.keys = list(hierarchy.encoder.images)
        with torch.no_grad():
            self.names = list(self.outputs(*example(hierarchy.encoder)))

    def outputs(self, features: Tensor, step: Tensor, *images: Tensor) -> dict[str, Tensor]:
        """The outputs by name."""
        vectors = self.hierarchy.encoder.standardized(features.reshape(1, 1, -1))
        pictures = {key: image.reshape(1, 1, *image.shape) for key, image in zip(self.keys, images, strict=True)}
        said = self.hierarchy(Inputs(vectors, pictures, step))
        found = {}
        for level, caller in enumerate(said.callers):
            if caller.selection is not None:
                found[f"selection_{level}"] = caller.selection[0, 0]
            if caller.emission is not None:
                found[f"control_{level}"] = caller.emission.numbers[0, 0]
        for level, log in enumerate(said.termination):
            found[f"termination_{level}"] = log[0, 0, :, 1].double().exp()
        return found

    def forward(self, features: Tensor, step: Tensor, *images: Tensor) -> tuple[Tensor, ...]:
        """The outputs, in the order of ``names``."""
        return tuple(self.outputs(features, step, *images).values())


def example(encoder: ObservationEncoder) -> tuple[Tensor, ...]:
    """Inputs of the right shapes."""
    images = [torch.zeros(shape, dtype=torch.uint8) for shape in encoder.images.values()]
    return (torch.zeros(len(encoder.mean), dtype=torch.float64), torch.zeros(1, dtype=torch.int64), *images)


def input_names(encoder: ObservationEncoder) -> list[str]:
    """What the inputs are called in ONNX."""
    return ["features", "step", *(f"image_{number}" for number in range(len(encoder.images)))]
