"""K independent linear maps as one operation: the K networks of a level are evaluated in one pass."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ddco_pyro.spec import Activation

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    "relu": nn.ReLU,
    "leaky_relu": nn.LeakyReLU,
    "elu": nn.ELU,
    "tanh": nn.Tanh,
}


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


class Perceptrons(nn.Sequential):
    """K multi-layer perceptrons with activation and dropout after every hidden layer; no hidden layer: K linear maps.

    :param outputs: None leaves the last map out: they then give ``features`` numbers, those of the last hidden layer.
    """

    def __init__(
        self,
        copies: int,
        inputs: int,
        hidden: tuple[int, ...],
        outputs: int | None,
        dropout: float = 0.0,
        activation: Activation = "relu",
    ) -> None:
        layers: list[nn.Module] = []
        features = inputs
        for size in hidden:
            layers += [StackedLinear(copies, features, size), ACTIVATIONS[activation](), nn.Dropout(dropout)]
            features = size
        if outputs is not None:
            layers.append(StackedLinear(copies, features, outputs))
            features = outputs
        super().__init__(*layers)
        self.copies, self.features = copies, features
        self.hidden, self.activation = len(hidden), activation

    def forward(self, values: Tensor) -> Tensor:
        """[K, M, inputs], or [1, M, inputs] shared by all K, to [K, M, features]."""
        said: Tensor = super().forward(values)
        return said.expand(self.copies, -1, -1)


def options_last(values: Tensor, batch: tuple[int, int]) -> Tensor:
    """[K, N · T, F] to [N, T, K, F]."""
    return values.transpose(0, 1).unflatten(0, batch)


def options_first(values: Tensor) -> Tensor:
    """[N, T, K, F] to [K, N · T, F]."""
    return values.flatten(0, 1).transpose(0, 1)
