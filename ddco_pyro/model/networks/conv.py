"""Convolutional layers followed by fully connected ones: the FF network of SM 1.2."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.perceptrons import (
    ACTIVATIONS,
    Network,
    NumpyForm,
    Perceptrons,
    State,
    arrays_of,
    options_last,
    vectors,
)
from ddco_pyro.spec import Activation, ConvolutionLayer, Pool

SHARPNESS = 10.0
"""Factor on the last maps before training with a spatial softmax. Under weak maps all places weigh nearly
the same, and training is slow."""

POOLED = 8
"""Fields along each side of a map, or of a picture for clustering, whose means are read."""


class Conv(Network):
    """K networks of convolutions over each picture, pooled, and a perceptron over pooled maps and vectors.

    :param layers: the convolutions.
    :param pool: ``mean`` of :data:`POOLED` × :data:`POOLED` fields of each map, ``flatten`` for the whole
        map, or the expected place under its softmax, ``spatial_softmax``.
    :param standardize: whether each picture is scaled to mean 0 and standard deviation 1.
    :raises ShapeError: there is no picture, or one is too small for the layers.
    """

    def __init__(
        self,
        shape: InputShape,
        copies: int,
        hidden: tuple[int, ...],
        dropout: float,
        activation: Activation,
        layers: Sequence[ConvolutionLayer],
        pool: Pool,
        standardize: bool,
    ) -> None:
        super().__init__()
        if not shape.images:
            why = "all of them are vectors: use network: mlp"
            raise ShapeError(f"needs an image among the observations, and {why}")
        self.reads, self.copies, self.pool = list(shape.vectors), copies, pool
        self.pictures = list(shape.images)
        self.activation, self.standardize = ACTIVATIONS[activation](), standardize
        pairs = list(itertools.pairwise(layers))
        firsts = [_convolution(layers[0], size[-1], copies) for size in shape.images.values()]
        self.convolutions = nn.ModuleList()
        for own in firsts:
            upper = (_convolution(layer, copies * below.filters, copies, copies) for below, layer in pairs)
            self.convolutions.append(nn.ModuleList([own, *upper]))
        if pool == "spatial_softmax":
            with torch.no_grad():
                lasts = (layers[-1] for layers in self._layers().values())
                for parameter in (each for layer in lasts for each in layer.parameters()):
                    parameter.mul_(SHARPNESS)
        maps = sum(self._map_features(key, own, shape.images[key]) for key, own in self._layers().items())
        self.layers = Perceptrons(copies, shape.vector + maps, hidden, dropout, activation)

    def forward(self, inputs: Inputs, state: State = ()) -> tuple[Tensor, State]:
        vector = inputs.vector.flatten(0, 1).expand(self.copies, -1, -1)
        layers = self._layers().items()
        maps = [self._maps(own, inputs.images[key].flatten(0, 1)) for key, own in layers]
        return options_last(self.layers(torch.cat([vector, *maps], dim=-1)), inputs.batch), state

    def numpy_form(self) -> NumpyForm:
        pictures = [self._picture_form(key, layers) for key, layers in self._layers().items()]
        return self.layers.numpy_form({"kind": "joined", "of": [vectors(self.reads, self.copies), *pictures]})

    def _picture_form(self, key: str, layers: Sequence[nn.Conv2d]) -> NumpyForm:
        each = [{"stride": own.stride[0], "padding": int(own.padding[0])} | arrays_of(own) for own in layers]
        form = {"kind": "convolutions", "key": key, "copies": self.copies, "layers": each, "pool": self.pool}
        return form | {"activation": self.layers.activation, "standardize": self.standardize}

    def _layers(self) -> dict[str, list[nn.Conv2d]]:
        """The convolutions of each picture."""
        each = ([one for one in own.children() if isinstance(one, nn.Conv2d)] for own in self.convolutions)
        return dict(zip(self.pictures, each, strict=True))

    def _maps(self, layers: Sequence[nn.Conv2d], image: Tensor) -> Tensor:
        """uint8 [M, H, W, C] to [K, M, features of the picture]."""
        maps = image.permute(0, 3, 1, 2).to(layers[0].weight.dtype) / 255
        maps = _standardized(maps) if self.standardize else maps
        for layer in layers:
            maps = self.activation(layer(maps))
        if self.pool == "mean":
            maps = _field_means(maps, POOLED)
        elif self.pool == "spatial_softmax":
            maps = _spatial_softmax(maps)
        return maps.reshape(len(image), self.copies, -1).transpose(0, 1)

    def _map_features(self, key: str, layers: Sequence[nn.Conv2d], size: tuple[int, ...]) -> int:
        """The number of features of a picture [H, W, C] for each option."""
        height, width, _ = size
        for layer in layers:
            height, width = (
                (length + 2 * int(layer.padding[0]) - layer.kernel_size[0]) // layer.stride[0] + 1
                for length in (height, width)
            )
            if min(height, width) < 1:
                why = "is too small for its layers: take some out, or pad"
                raise ShapeError(f"{key} of {size[0]} × {size[1]} {why}")
        each = {"mean": POOLED**2, "flatten": height * width, "spatial_softmax": 2}[self.pool]
        return layers[-1].out_channels // self.copies * each


def _convolution(layer: ConvolutionLayer, channels: int, copies: int, groups: int = 1) -> nn.Conv2d:
    size = copies * layer.filters
    return nn.Conv2d(channels, size, layer.kernel, layer.stride, layer.padding, groups=groups)


def _standardized(pictures: Tensor) -> Tensor:
    """Each picture [M, C, H, W] less its mean, over its standard deviation or that of one bright number."""
    centred = pictures - pictures.mean((1, 2, 3), keepdim=True)
    variance = centred.square().mean((1, 2, 3), keepdim=True)  # torch.var_mean is several times as slow
    return centred / variance.clamp(min=1 / pictures[0].numel()).sqrt()


def _field_means(maps: Tensor, count: int) -> Tensor:
    """The means of ``count`` × ``count`` fields of each map [..., H, W], [..., count, count]."""
    if maps.device.type == "cpu":
        return nn.functional.adaptive_avg_pool2d(maps, count)
    rows, columns = (_shares(length, count).to(maps) for length in maps.shape[-2:])
    return rows @ maps @ columns.mT  # on a GPU torch's own adds gradients in no fixed order


def _shares(length: int, count: int) -> Tensor:
    """The weight of each place in the mean of each field of ``adaptive_avg_pool2d``, [count, length]."""
    field, place = torch.arange(count)[:, None], torch.arange(length)
    inside = (place >= field * length // count) & (place < -(-(field + 1) * length // count))
    return inside / inside.sum(1, keepdim=True)


def _spatial_softmax(maps: Tensor) -> Tensor:
    """The expected (row, column), each from -1 to 1, under each map's softmax, [..., H, W] to [..., 2]."""
    height, width = maps.shape[-2:]
    weights = maps.flatten(-2).softmax(-1).unflatten(-1, (height, width))
    rows, columns = (torch.linspace(-1, 1, length, device=maps.device) for length in (height, width))
    return torch.stack([(weights.sum(-1) * rows).sum(-1), (weights.sum(-2) * columns).sum(-1)], -1)
