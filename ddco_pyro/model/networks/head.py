"""What networks make of a trunk that they share."""

from __future__ import annotations

from torch import Tensor, nn

from ddco_pyro.model.networks.numpy_form import NumpyForm, perceptrons
from ddco_pyro.model.networks.stacked import Perceptrons, options_first, options_last
from ddco_pyro.model.networks.state import Trunk
from ddco_pyro.spec import Activation


class Head(nn.Module):
    """K perceptrons, each over the features of its own copy of a trunk, or all over those of a single one.

    :param outputs: None for a trunk of the next: without a last map, ``features`` numbers.
    """

    def __init__(
        self,
        trunk: Trunk,
        outputs: int | None,
        copies: int,
        hidden: tuple[int, ...] = (),
        dropout: float = 0.0,
        activation: Activation = "relu",
    ) -> None:
        super().__init__()
        self.reads = (trunk.copies, trunk.features)
        self.layers = Perceptrons(copies, trunk.features, hidden, outputs, dropout, activation)
        self.features = self.layers.features

    def forward(self, features: Tensor) -> Tensor:
        """[N, T, K or 1, features] to [N, T, K, outputs]."""
        trajectories, steps = features.shape[:2]
        return options_last(self.layers(options_first(features)), (trajectories, steps))

    def numpy_form(self) -> NumpyForm:
        """What the numpy runner has to know of it."""
        return perceptrons(self.layers, ({"kind": "trunk"}, {}))
