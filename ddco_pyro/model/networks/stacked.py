"""K independent linear maps as one operation: the K networks of a level are evaluated in one pass."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class StackedLinear(nn.Module):
    """y_k = x_k W_k + b_k for k = 1..K; initialised as ``torch.nn.Linear`` would each of them."""

    def __init__(self, copies: int, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(max(inputs, 1))
        self.weight = nn.Parameter(torch.empty(copies, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(copies, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor, maps: Tensor | None = None) -> Tensor:
        """[K, M, inputs], or [1, M, inputs] shared by all K, to [K, M, outputs].

        :param maps: indices of the maps to apply, which then are the K; None for all of them.
        """
        if maps is not None:
            return torch.baddbmm(self.bias[maps], x, self.weight[maps])
        if x.shape[0] == 1:
            return self._shared(x[0])
        return torch.baddbmm(self.bias, x, self.weight)

    def _shared(self, x: Tensor) -> Tensor:
        copies, inputs, outputs = self.weight.shape
        joined = self.weight.transpose(0, 1).reshape(inputs, copies * outputs)
        return (x @ joined).reshape(-1, copies, outputs).transpose(0, 1) + self.bias


def stacked_mlp(copies: int, inputs: int, hidden: tuple[int, ...], outputs: int, dropout: float) -> nn.Sequential:
    """K multi-layer perceptrons with ReLU and dropout after every hidden layer; no hidden layer: K linear maps."""
    layers: list[nn.Module] = []
    for size in hidden:
        layers += [StackedLinear(copies, inputs, size), nn.ReLU(), nn.Dropout(dropout)]
        inputs = size
    return nn.Sequential(*layers, StackedLinear(copies, inputs, outputs))
