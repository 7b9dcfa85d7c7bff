"""A convolutional layer followed by a fully connected one: the FF network of SM 1.2."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.numpy_form import NumpyForm, arrays_of, perceptrons
from ddco_pyro.model.networks.stacked import stacked_mlp

POOLED = 8
"""Each feature map is averaged to POOLED × POOLED before the fully connected layer, whatever the image's size."""


class Conv(nn.Module):
    """K networks of one convolution (stride 2, ReLU) over the images and a perceptron over it and the vector."""

    def __init__(
        self,
        shape: InputShape,
        outputs: int,
        copies: int,
        hidden: tuple[int, ...],
        dropout: float,
        filters: int,
        kernel: int,
    ) -> None:
        super().__init__()
        if not shape.images:
            raise ShapeError("needs an image among the observations, and all of them are vectors: use network: mlp")
        self.copies = copies
        self.convolutions = nn.ModuleDict(
            {
                key: nn.Conv2d(size[-1], copies * filters, kernel, stride=2, padding=kernel // 2)
                for key, size in shape.images.items()
            }
        )
        features = shape.vector + len(shape.images) * filters * POOLED**2
        self.layers = stacked_mlp(copies, features, hidden, outputs, dropout)

    def forward(self, inputs: Inputs) -> Tensor:
        """[N, T, K, outputs]."""
        vector = inputs.vector.flatten(0, 1).expand(self.copies, -1, -1)
        maps = [self._features(key, image.flatten(0, 1)) for key, image in inputs.images.items()]
        found = self.layers(torch.cat([vector, *maps], dim=-1))
        return found.transpose(0, 1).reshape(*inputs.batch, *found.shape[::2])

    def numpy_form(self) -> NumpyForm:
        """What the numpy runner has to know of it."""
        about, arrays = perceptrons(self.layers)
        for key, convolution in self.convolutions.items():
            arrays |= arrays_of(convolution, f"image.{key}")
        return about | {"images": list(self.convolutions), "pooled": POOLED}, arrays

    def _features(self, key: str, image: Tensor) -> Tensor:
        """uint8 [M, H, W, C] to [K, M, filters · POOLED²]."""
        scaled = image.permute(0, 3, 1, 2).float() / 255
        maps = torch.relu(self.convolutions[key](scaled))
        pooled = nn.functional.adaptive_avg_pool2d(maps, POOLED)
        return pooled.reshape(len(image), self.copies, -1).transpose(0, 1)
