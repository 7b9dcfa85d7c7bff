"""The built-in encoders: convolutions with random weights, and those that an autoencoder trains."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count, islice

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.encoding.pictures import AT_ONCE, Pictures
from ddco_pyro.events import OnEvent, TrainingBegan, TrainingEnded, UpdatesDone
from ddco_pyro.model.networks import Inputs, InputShape
from ddco_pyro.model.networks.conv import SHARPNESS, Conv
from ddco_pyro.model.seeding import seeded
from ddco_pyro.spec import ConvolutionLayer

_FIRST = ConvolutionLayer(filters=16, kernel=5, stride=2, padding=2)
BUILT_IN = {"random_conv": 64, "autoencoder": 32}
"""Maps of the second convolution of each. The features are the expected row and column of every map under its
softmax."""

TARGET = 32
"""Most rows and columns of the small picture that the decoder gives."""

HIDDEN = 128

UPDATES = 2000
"""Gradient steps, each on :data:`ddco_pyro.encoding.pictures.AT_ONCE` pictures."""

SHOWN_EVERY = 50
"""Gradient steps between two events."""

LEARNING_RATE = 3e-3


class PictureNetwork(nn.Module):
    """uint8 pictures [N, H, W, C] to features [N, F], by a network that reads them under a key.

    ``code`` are bytes that decide the features, beside the name of the encoder, its seed and the pictures.
    """

    network: nn.Module
    key = "picture"
    code = b""

    def forward(self, pictures: Tensor) -> Tensor:
        """Features of each picture by itself."""
        features, _ = self.network(Inputs({}, {self.key: pictures[:, None]}, torch.zeros(1)), ())
        return features[:, 0, 0]  # type: ignore[no-any-return]

    def encode(self, pictures: np.ndarray) -> np.ndarray:
        """Features of each picture by itself, float32."""
        with torch.no_grad():
            return self(torch.from_numpy(np.ascontiguousarray(pictures))).numpy()


class Convolutions(PictureNetwork):
    """A built-in encoder.

    :param kind: a name in :data:`BUILT_IN`.
    :param shape: of a picture.
    :param seed: of the weights.
    """

    def __init__(self, kind: str, shape: Sequence[int], seed: int) -> None:
        super().__init__()
        layers = (_FIRST, ConvolutionLayer(filters=BUILT_IN[kind], kernel=3, padding=1))
        with seeded(seed):
            images = InputShape({}, {self.key: tuple(shape)})
            self.network = Conv(images, 1, (), 0.0, "relu", 0, 0, layers, "spatial_softmax", 0, False)
        if kind == "random_conv":  # sharp maps help training alone; random ones say less
            self.network.strengthen(1 / SHARPNESS)


class Autoencoder(nn.Module):
    """A deep spatial autoencoder (Finn et al., 2016): it gives the small picture from where each map is active.

    :param encoder: pictures to features.
    :param shape: of a picture.
    :param seed: of the decoder's weights.
    """

    def __init__(self, encoder: Convolutions, shape: Sequence[int], seed: int) -> None:
        super().__init__()
        self.encoder = encoder
        self.target = (min(TARGET, shape[0]), min(TARGET, shape[1]))
        with seeded(seed + 1):
            outputs = self.target[0] * self.target[1] * shape[2]
            features = int(encoder.network.features)  # type: ignore[arg-type]  # torch types every attribute alike
            self.decoder = nn.Sequential(nn.Linear(features, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))

    def loss(self, pictures: Tensor) -> Tensor:
        """Mean squared error of the small picture, whose numbers lie between 0 and 1."""
        small = nn.functional.adaptive_avg_pool2d(pictures.permute(0, 3, 1, 2).float() / 255, self.target)
        return nn.functional.mse_loss(self.decoder(self.encoder(pictures)), small.flatten(1))


def train(encoder: Convolutions, pictures: Pictures, seed: int, updates: int, on_event: OnEvent) -> None:
    """Train an encoder as the first half of an autoencoder; the same arguments give the same bits."""
    model = Autoencoder(encoder, pictures.shape, seed)
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    on_event(TrainingBegan("the autoencoder", updates))
    errors: list[float] = []
    for done, batch in enumerate(islice(_batches(pictures, seed), updates), 1):
        loss = model.loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(loss.item())
        if done % SHOWN_EVERY == 0 or done == updates:
            on_event(UpdatesDone(done, float(np.mean(errors))))
            errors.clear()
    on_event(TrainingEnded("the autoencoder"))


def _batches(pictures: Pictures, seed: int) -> Iterator[Tensor]:
    """Pictures of the gradient steps, epoch after epoch without end."""
    size = min(AT_ONCE, pictures.number)
    for epoch in count():
        frames = pictures.at_random(seed, epoch)
        yield from (torch.from_numpy(np.stack([*islice(frames, size)])) for _ in range(pictures.number // size))
