"""A worked example of one's own network; specs name it by ``network: ddco_tasks.example_network:Radial``."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks import Inputs, InputShape


class Radial(nn.Module):
    """How near the vectors are to each of ``outputs`` learned centres, from 0 to 1.

    :param width: the distance at which the nearness is exp(-1/2).
    """

    features = 32
    """Centres of a trunk."""

    def __init__(self, shape: InputShape, outputs: int, copies: int, width: float = 1.0) -> None:
        super().__init__()
        self.centres, self.width = nn.Parameter(torch.randn(copies, outputs, shape.vector)), width

    def forward(self, inputs: Inputs) -> Tensor:
        """[N, T, copies, outputs]."""
        apart = inputs.vector[:, :, None, None] - self.centres
        return (-0.5 * (apart / self.width).square().sum(-1)).exp()
