"""Linear maps and multi-layer perceptrons of the observation vector (SM 1.1, SM 1.3)."""

from __future__ import annotations

from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.numpy_form import NumpyForm, perceptrons
from ddco_pyro.model.networks.stacked import stacked_mlp


class Mlp(nn.Module):
    """K perceptrons over the observation vector."""

    def __init__(self, shape: InputShape, outputs: int, copies: int, hidden: tuple[int, ...], dropout: float) -> None:
        super().__init__()
        refuse_images(shape)
        self.layers = stacked_mlp(copies, shape.vector, hidden, outputs, dropout)

    def forward(self, inputs: Inputs) -> Tensor:
        """[N, T, K, outputs]."""
        found: Tensor = self.layers(inputs.vector.flatten(0, 1).unsqueeze(0))
        return found.transpose(0, 1).reshape(*inputs.batch, *found.shape[::2])

    def numpy_form(self) -> NumpyForm:
        """What the numpy runner has to know of it."""
        return perceptrons(self.layers)


class Linear(Mlp):
    """K linear maps of the observation vector."""

    def __init__(self, shape: InputShape, outputs: int, copies: int) -> None:
        super().__init__(shape, outputs, copies, hidden=(), dropout=0.0)


def refuse_images(shape: InputShape) -> None:
    """:raises ShapeError: where there are images, which only a convolution can read."""
    if shape.images:
        names = ", ".join(sorted(shape.images))
        raise ShapeError(f"reads vectors, but {names} are images: use network: conv, or leave them out")
