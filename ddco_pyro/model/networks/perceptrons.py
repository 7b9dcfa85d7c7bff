"""Stacked networks, K of them evaluated in one pass: the base class, and those made of perceptrons."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape, ShapeError
from ddco_pyro.model.tables import by_step, by_trajectory
from ddco_pyro.spec import Activation

NumpyForm = dict[str, Any]
"""What the numpy runner of exports has to know: a tree of facts and arrays.

Each node has a ``kind``, a method of :class:`ddco_pyro.exporting.runner.NumpyNetworks`, and reads what its
``of`` gives."""


def vectors(keys: Sequence[str], copies: int) -> NumpyForm:
    """The form of these vectors side by side, for each of K copies."""
    return {"kind": "vectors", "keys": list(keys), "copies": copies}


def arrays_of(layer: nn.Module) -> dict[str, np.ndarray]:
    """The parameters of a layer by name."""
    return {key: parameter.detach().numpy() for key, parameter in layer.named_parameters()}


State = tuple[Tensor, ...]
"""What a network remembers of the steps before, tensors [N, ...]; () for a network without memory."""

States = Mapping[str, State]
"""The states of several networks by name."""

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    "relu": nn.ReLU,
    "leaky_relu": nn.LeakyReLU,
    "elu": nn.ELU,
    "tanh": nn.Tanh,
}


class StackedLinear(nn.Module):
    """y_k = x_k W_k + b_k for k = 1..K; each map is initialised as ``torch.nn.Linear`` would be."""

    def __init__(self, copies: int, inputs: int, outputs: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(max(inputs, 1))
        self.weight = nn.Parameter(torch.empty(copies, inputs, outputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(copies, 1, outputs).uniform_(-bound, bound))

    def forward(self, x: Tensor, maps: Tensor | None = None) -> Tensor:
        """[K, M, inputs], or [1, M, inputs] shared by all K, to [K, M, outputs].

        :param maps: indices of the K maps to apply; None for all maps.
        """
        if maps is not None:
            return torch.baddbmm(self.bias[maps], x, self.weight[maps])
        if x.shape[0] > 1:
            return torch.baddbmm(self.bias.mT, self.weight.mT, x.mT).mT
        each = torch.addmm(self.bias.flatten().unsqueeze(1), self.weight.mT.flatten(0, 1), x.squeeze(0).T)
        return each.unflatten(0, (len(self.weight), -1)).mT


class Perceptrons(nn.Sequential):
    """K multi-layer perceptrons, with activation and dropout after hidden layers; ``features`` numbers each.

    Without hidden layers they give their inputs.
    """

    def __init__(
        self,
        copies: int,
        inputs: int,
        hidden: tuple[int, ...],
        dropout: float = 0.0,
        activation: Activation = "relu",
    ) -> None:
        layers: list[nn.Module] = []
        sizes = (inputs, *hidden)
        for size, following in zip(sizes, hidden, strict=False):
            layers += [StackedLinear(copies, size, following), ACTIVATIONS[activation](), nn.Dropout(dropout)]
        super().__init__(*layers)
        self.copies, self.features = copies, sizes[-1]
        self.hidden, self.activation = len(hidden), activation

    def forward(self, values: Tensor) -> Tensor:
        """[K, M, inputs], or [1, M, inputs] shared by all K, to [K, M, features]."""
        features: Tensor = super().forward(values)
        return features.expand(self.copies, -1, -1)

    def numpy_form(self, of: NumpyForm) -> NumpyForm:
        """The numpy form of these layers over what ``of`` gives."""
        linear = [arrays_of(layer) for layer in self if isinstance(layer, StackedLinear)]
        form = {"kind": "perceptrons", "of": of, "layers": linear, "hidden": self.hidden}
        return form | {"activation": self.activation, "copies": self.copies, "steps": 1}


class Network(nn.Module):
    """K networks side by side, a trunk for others to read; :meth:`add_head` makes it one that gives outputs.

    Every network is called as ``network(inputs, state)``. It maps T steps of N trajectories to [N, T, K,
    features] and the state after them. A call on T steps gives what T calls on one step each give, with the
    state carried from each to the next.

    :ivar copies: K; 1 where all options read the same features.
    :ivar layers: the last layers, which the head joins.
    """

    copies: int
    layers: Perceptrons

    @property
    def features(self) -> int:
        """How many numbers each of the K networks gives at a step."""
        return self.layers.features

    def initial_state(self, trajectories: int) -> State:
        """The state before the first step of N trajectories."""
        return ()

    def add_head(self, outputs: int) -> Self:
        """End in K linear maps to ``outputs`` numbers."""
        self.layers.append(StackedLinear(self.layers.copies, self.layers.features, outputs))
        self.layers.features = outputs
        return self

    def begin_at(self, outputs: int, value: float = 0.0) -> None:
        """Have the last ``outputs`` numbers of the head start at a value, whatever is observed."""
        with torch.no_grad():
            for name, parameter in self.layers[-1].named_parameters():
                parameter[..., -outputs:] = value if name == "bias" else 0.0

    def numpy_form(self) -> NumpyForm | None:
        """The network for the numpy runner of an exported controller; None where it cannot evaluate this."""
        return None


class Mlp(Network):
    """K perceptrons over all vectors side by side (SM 1.1, SM 1.3).

    Without hidden layers the head is K linear maps.

    :raises ShapeError: there are images, which only a convolution can read.
    """

    def __init__(
        self,
        shape: InputShape,
        copies: int,
        hidden: tuple[int, ...] = (),
        dropout: float = 0.0,
        activation: Activation = "relu",
    ) -> None:
        super().__init__()
        self.copies, self.reads = copies, _vectors_of(shape)
        self.layers = Perceptrons(copies, shape.vector, hidden, dropout, activation)

    @property
    def is_linear(self) -> bool:
        """Whether it is K linear maps of vectors, or of none."""
        return len(self.layers) == 1

    def forward(self, inputs: Inputs, state: State = ()) -> tuple[Tensor, State]:
        values = by_step(self._read(inputs))
        said: Tensor = self.layers(values.flatten(1).T.unsqueeze(0))
        return by_trajectory(said.mT.unflatten(2, values.shape[1:])), state

    def _read(self, inputs: Inputs) -> Tensor:
        """The vectors that it reads, side by side, [N, T, F]."""
        return inputs.vector

    def numpy_form(self) -> NumpyForm:
        return self.layers.numpy_form(vectors(self.reads, self.copies))


class Constant(Mlp):
    """K biases: linear maps of no observation."""

    def __init__(self, shape: InputShape, copies: int) -> None:
        super().__init__(InputShape({}), copies)

    def _read(self, inputs: Inputs) -> Tensor:
        return inputs.vector[..., :0]


def linear_maps(networks: Mapping[str, Network], inputs: Inputs) -> dict[str, Tensor]:
    """What the linear networks among these give, [N, T, K, n]: one product for all that read the same."""
    readers: dict[tuple[str, ...], dict[str, StackedLinear]] = {}
    for name, network in networks.items():
        if not (isinstance(network, Mlp) and network.is_linear):
            continue
        if isinstance(layer := network.layers[0], StackedLinear):
            readers.setdefault(tuple(network.reads), {})[name] = layer
    given: dict[str, Tensor] = {}
    for reads, layers in readers.items():
        weight = torch.cat([layer.weight.mT.flatten(0, 1) for layer in layers.values()])
        bias = torch.cat([layer.bias.flatten() for layer in layers.values()]).unsqueeze(1)
        values = by_step(inputs.joined(reads))
        said = torch.addmm(bias, weight, values.flatten(1)).unflatten(1, values.shape[1:])
        parts = said.split([layer.bias.numel() for layer in layers.values()])
        for part, (name, layer) in zip(parts, layers.items(), strict=True):
            given[name] = by_trajectory(part.unflatten(0, (len(layer.bias), -1)))
    return given


class PerTimestep(Network):
    """K × T perceptrons over the vectors: the per-timestep policy of SM 1.3.

    The t-th reads step t; the last reads the steps past the longest demonstration.

    :raises ShapeError: there are images, which only a convolution can read.
    """

    def __init__(
        self, shape: InputShape, copies: int, hidden: tuple[int, ...], dropout: float, activation: Activation
    ) -> None:
        super().__init__()
        self.reads, self.copies, self.steps = _vectors_of(shape), copies, shape.steps
        self.layers = Perceptrons(shape.steps * copies, shape.vector, hidden, dropout, activation)

    def forward(self, inputs: Inputs, state: State = ()) -> tuple[Tensor, State]:
        times = inputs.time.clamp(max=self.steps - 1)
        maps = torch.stack([times * self.copies + copy for copy in range(self.copies)], dim=1)
        values = inputs.vector.transpose(0, 1).repeat_interleave(self.copies, dim=0)
        for layer in self.layers:
            values = layer(values, maps.flatten()) if isinstance(layer, StackedLinear) else layer(values)
        return values.unflatten(0, maps.shape).permute(2, 0, 1, 3), state

    def numpy_form(self) -> NumpyForm:
        form = self.layers.numpy_form(vectors(self.reads, self.copies))
        return form | {"copies": self.copies, "steps": self.steps}


class Branches(Network):
    """K perceptrons over the features of several networks, side by side: the policy of SM 1.4.

    The state holds those of the branches, one after another.
    """

    def __init__(
        self,
        shape: InputShape,
        copies: int,
        hidden: tuple[int, ...],
        dropout: float,
        activation: Activation,
        of: Mapping[str, Network],
    ) -> None:
        super().__init__()
        self.names, self.copies = tuple(of), copies
        self.of = nn.ModuleList(of.values())
        features = sum(branch.features for branch in of.values())
        self.layers = Perceptrons(copies, features, hidden, dropout, activation)

    def branches(self) -> list[Network]:
        return [branch for branch in self.of if isinstance(branch, Network)]

    def initial_state(self, trajectories: int) -> State:
        return tuple(tensor for branch in self.branches() for tensor in branch.initial_state(trajectories))

    def forward(self, inputs: Inputs, state: State) -> tuple[Tensor, State]:
        values: list[Tensor] = []
        after: State = ()
        for branch in self.branches():
            features, own = branch(inputs, state[len(after) :][: len(branch.initial_state(1))])
            values.append(options_first(features))
            after = (*after, *own)
        return options_last(self.layers(torch.cat(values, -1)), inputs.batch), after

    def numpy_form(self) -> NumpyForm | None:
        forms = [branch.numpy_form() for branch in self.branches()]
        return None if None in forms else self.layers.numpy_form({"kind": "joined", "of": forms})


def _vectors_of(shape: InputShape) -> list[str]:
    """The names of the vectors."""
    if shape.images:
        names = ", ".join(sorted(shape.images))
        remedy = "use network: conv, or name the vectors that it is to read in inputs"
        raise ShapeError(f"reads vectors, but {names} are images: {remedy}")
    return list(shape.vectors)


def options_last(values: Tensor, batch: tuple[int, int]) -> Tensor:
    """[K, N · T, F] to [N, T, K, F]."""
    return values.transpose(0, 1).unflatten(0, batch)


def options_first(values: Tensor) -> Tensor:
    """[N, T, K, F] to [K, N · T, F]."""
    return values.flatten(0, 1).transpose(0, 1)
