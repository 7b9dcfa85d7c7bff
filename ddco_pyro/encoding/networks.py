"""The encoders that are built in: convolutions that stay as they were drawn, and those of an autoencoder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.model.networks import Inputs, InputShape
from ddco_pyro.model.networks.conv import SHARPNESS, Conv
from ddco_pyro.model.seeding import seeded
from ddco_pyro.spec import ConvolutionLayer

_KEY = "picture"
_FIRST = ConvolutionLayer(filters=16, kernel=5, stride=2, padding=2)
BUILT_IN = {"random_conv": 64, "autoencoder": 32}
"""Maps of each: there are two convolutions, and two features of every map, the row and the column where it is active
(the expected place under its softmax)."""

TARGET = 32
"""The decoder gives the picture reduced to at most so many rows and columns."""

HIDDEN = 128


class Convolutions(nn.Module):
    """uint8 pictures [N, H, W, C] to features [N, F].

    :param kind: a name in :data:`BUILT_IN`.
    :param shape: of a picture.
    :param seed: of the weights.
    """

    def __init__(self, kind: str, shape: Sequence[int], seed: int) -> None:
        super().__init__()
        layers = (_FIRST, ConvolutionLayer(filters=BUILT_IN[kind], kernel=3, padding=1))
        with seeded(seed):
            images = InputShape({}, {_KEY: tuple(shape)})
            self.maps = Conv(images, 1, (), 0.0, "relu", 0, 0, layers, "spatial_softmax", 0, False)
        if kind == "random_conv":  # nothing will train them, and strong maps that are random tell less
            self.maps.strengthen(1 / SHARPNESS)
        self.features = self.maps.features

    def forward(self, pictures: Tensor) -> Tensor:
        """Features of each picture by itself."""
        maps: Tensor = self.maps(Inputs({}, {_KEY: pictures[:, None]}, torch.zeros(1)))[0]
        return maps[:, 0, 0]

    def encode(self, pictures: np.ndarray) -> np.ndarray:
        """The same of and as numpy arrays, float32."""
        with torch.no_grad():
            return self(torch.from_numpy(np.ascontiguousarray(pictures))).numpy()


class Autoencoder(nn.Module):
    """A deep spatial autoencoder (Finn et al., 2016): where each map is active, and the small picture from that alone.

    :param encoder: pictures to features; :param shape: of a picture; :param seed: of the decoder's weights.
    """

    def __init__(self, encoder: Convolutions, shape: Sequence[int], seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.target = (min(TARGET, shape[0]), min(TARGET, shape[1]))
        with seeded(seed + 1):
            outputs = self.target[0] * self.target[1] * shape[2]
            self.decoder = nn.Sequential(nn.Linear(encoder.features, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))

    def loss(self, pictures: Tensor) -> Tensor:
        """Mean squared error of the small picture, in units of the brightest."""
        small = nn.functional.adaptive_avg_pool2d(pictures.permute(0, 3, 1, 2).float() / 255, self.target)
        return nn.functional.mse_loss(self.decoder(self.encoder(pictures)), small.flatten(1))
