"""Linear maps and multi-layer perceptrons of the observed vectors (SM 1.1, SM 1.3)."""

from __future__ import annotations

from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.networks.numpy_form import NumpyForm, perceptrons, vectors
from ddco_pyro.model.networks.stacked import Perceptrons, options_last
from ddco_pyro.spec import Activation


class Mlp(nn.Module):
    """K perceptrons over all vectors side by side."""

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
        self.layers = Perceptrons(copies, shape.vector, hidden, outputs, dropout, activation)
        self.features = self.layers.features

    def forward(self, inputs: Inputs) -> Tensor:
        """[N, T, K, outputs]."""
        return options_last(self.layers(inputs.vector.flatten(0, 1).unsqueeze(0)), inputs.batch)

    def numpy_form(self) -> NumpyForm:
        """What the numpy runner has to know of it."""
        return perceptrons(self.layers, vectors(self.reads, self.layers.copies))


class Linear(Mlp):
    """K linear maps of all vectors; as a trunk the vectors themselves."""

    def __init__(self, shape: InputShape, outputs: int | None, copies: int) -> None:
        super().__init__(shape, outputs, copies, hidden=(), dropout=0.0, activation="relu")


def refuse_images(shape: InputShape) -> None:
    """:raises ShapeError: where there are images, which only a convolution can read."""
    if shape.images:
        names = ", ".join(sorted(shape.images))
        remedy = "use network: conv, or name the vectors that it is to read in inputs"
        raise ShapeError(f"reads vectors, but {names} are images: {remedy}")
