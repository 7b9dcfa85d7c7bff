"""What the policy and the termination of a level make of the trunk that they share."""

from __future__ import annotations

from torch import Tensor, nn

from ddco_pyro.model.networks.numpy_form import NumpyForm, perceptrons
from ddco_pyro.model.networks.stacked import Perceptrons, options_first, options_last
from ddco_pyro.spec import Activation


class Head(nn.Module):
    """K perceptrons, each over the features of its own copy of a trunk."""

    def __init__(
        self,
        features: int,
        outputs: int,
        copies: int,
        hidden: tuple[int, ...] = (),
        dropout: float = 0.0,
        activation: Activation = "relu",
    ) -> None:
        super().__init__()
        self.reads = (copies, features)
        self.layers = Perceptrons(copies, features, hidden, outputs, dropout, activation)

    def forward(self, features: Tensor) -> Tensor:
        """[N, T, K, features] to [N, T, K, outputs]."""
        trajectories, steps = features.shape[:2]
        return options_last(self.layers(options_first(features)), (trajectories, steps))

    def numpy_form(self) -> NumpyForm:
        """What the numpy runner has to know of it."""
        return perceptrons(self.layers, ({"kind": "trunk"}, {}))
