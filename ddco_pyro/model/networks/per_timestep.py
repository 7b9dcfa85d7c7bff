"""One perceptron for each step of time: the per-timestep policy of SM 1.3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape
from ddco_pyro.model.networks.mlp import refuse_images
from ddco_pyro.model.networks.numpy_form import NumpyForm, perceptrons, vectors
from ddco_pyro.model.networks.stacked import Perceptrons, StackedLinear
from ddco_pyro.spec import Activation


class PerTimestep(nn.Module):
    """K × T perceptrons; step t is read by the t-th, steps past the longest demonstration by the last."""

    def __init__(
        self,
        shape: InputShape,
        outputs: int | None,
        copies: int,
        hidden: tuple[int, ...],
        dropout: float,
        activation: Activation,
    ) -> None:
        super().__init__()
        refuse_images(shape)
        self.reads = list(shape.vectors)
        self.copies, self.steps = copies, shape.steps
        self.layers = Perceptrons(shape.steps * copies, shape.vector, hidden, outputs, dropout, activation)
        self.features = self.layers.features

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
        about, arrays = perceptrons(self.layers, vectors(self.reads, self.copies))
        return about | {"copies": self.copies, "steps": self.steps}, arrays
