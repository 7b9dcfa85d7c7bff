"""One perceptron for each step of time: the per-timestep policy of SM 1.3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.networks.inputs import Inputs, InputShape
from ddco_pyro.networks.mlp import refuse_images
from ddco_pyro.networks.stacked import stacked_mlp


class PerTimestep(nn.Module):
    """K × T perceptrons; step t is read by the t-th, steps past the longest demonstration by the last."""

    def __init__(
        self, shape: InputShape, outputs: int, copies: int, hidden: tuple[int, ...] = (64,), dropout: float = 0.0
    ) -> None:
        super().__init__()
        refuse_images(shape)
        self.copies, self.steps = copies, shape.steps
        self.layers = stacked_mlp(shape.steps * copies, shape.vector, hidden, outputs, dropout)

    def forward(self, inputs: Inputs) -> Tensor:
        """[N, T, K, outputs]."""
        trajectories, steps = inputs.batch
        if steps == self.steps and bool((inputs.time == torch.arange(steps)).all()):
            per_step = inputs.vector.transpose(0, 1)
            found = self.layers(per_step.repeat_interleave(self.copies, dim=0))
            return found.unflatten(0, (steps, self.copies)).permute(2, 0, 1, 3)
        every = self.layers(inputs.vector.flatten(0, 1).unsqueeze(0))
        every = every.unflatten(0, (self.steps, self.copies)).unflatten(2, (trajectories, steps))
        return every[inputs.time.clamp(max=self.steps - 1), :, :, torch.arange(steps)].permute(2, 0, 1, 3)
