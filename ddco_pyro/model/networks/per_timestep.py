"""One perceptron for each step of time: the per-timestep policy of SM 1.3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape
from ddco_pyro.model.networks.mlp import refuse_images
from ddco_pyro.model.networks.numpy_form import NumpyForm, perceptrons
from ddco_pyro.model.networks.stacked import StackedLinear, stacked_mlp


class PerTimestep(nn.Module):
    """K × T perceptrons; step t is read by the t-th, steps past the longest demonstration by the last."""

    def __init__(self, shape: InputShape, outputs: int, copies: int, hidden: tuple[int, ...], dropout: float) -> None:
        super().__init__()
        refuse_images(shape)
        self.copies, self.steps = copies, shape.steps
        self.layers = stacked_mlp(shape.steps * copies, shape.vector, hidden, outputs, dropout)

    def forward(self, inputs: Inputs) -> Tensor:
        """[N, T, K, outputs]."""
        times = inputs.time.clamp(max=self.steps - 1)
        maps = torch.stack([times * self.copies + copy for copy in range(self.copies)], dim=1)
        values = inputs.vector.transpose(0, 1).repeat_interleave(self.copies, dim=0)
        for layer in self.layers:
            values = layer(values, maps.flatten()) if isinstance(layer, StackedLinear) else layer(values)
        return values.unflatten(0, maps.shape).permute(2, 0, 1, 3)

    def numpy_form(self) -> NumpyForm:
        """What the numpy runner has to know of it."""
        about, arrays = perceptrons(self.layers)
        return about | {"copies": self.copies, "steps": self.steps}, arrays
