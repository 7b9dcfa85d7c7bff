"""Long short-term memory over another network: the RNN of SM 1.2."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from ddco_pyro.model.networks.inputs import Inputs, InputShape
from ddco_pyro.model.networks.perceptrons import (
    Mlp,
    Network,
    NumpyForm,
    Perceptrons,
    StackedLinear,
    State,
    arrays_of,
    options_first,
    options_last,
)


class Lstm(Network):
    """K LSTMs, of a layer for each size in ``hidden``, over the features of ``over``, or over the vectors.

    The state holds that of ``over``, then h and c [N, K, size] of each layer.

    :param horizon: steps of a window; h and c are zeros again before the first step of each. Or None.
    """

    def __init__(
        self,
        shape: InputShape,
        copies: int,
        over: Network | None,
        hidden: tuple[int, ...],
        horizon: int | None,
    ) -> None:
        super().__init__()
        self.copies, self.horizon = copies, horizon
        self.over = over or Mlp(shape, copies)
        sizes = zip([self.over.features, *hidden], hidden, strict=False)
        self.memory = nn.ModuleList(StackedLstm(copies, *pair) for pair in sizes)
        self.layers = Perceptrons(copies, hidden[-1], ())

    def initial_state(self, trajectories: int) -> State:
        own = [layer.recurrent.new_zeros(trajectories, *layer.size) for layer in self._memory() for _ in "hc"]
        return (*self.over.initial_state(trajectories), *own)

    def forward(self, inputs: Inputs, state: State) -> tuple[Tensor, State]:
        within = len(state) - 2 * len(self.memory)
        features, after = self.over(inputs, state[:within])
        values = options_first(features)
        for number, layer in enumerate(self._memory()):
            h, c = state[within + 2 * number :][:2]
            if self.horizon is None:
                values, *own = layer(values, inputs.batch, h, c)
            else:
                values, *own = _in_windows(layer, values, inputs, h, c, self.horizon)
            after = (*after, *own)
        return options_last(self.layers(values), inputs.batch), after

    def numpy_form(self) -> NumpyForm | None:
        of = self.over.numpy_form()
        if of is None:
            return None
        layers = [arrays_of(layer) for layer in self.memory]
        return self.layers.numpy_form({"kind": "lstm", "of": of, "layers": layers, "horizon": self.horizon})

    def _memory(self) -> list[StackedLstm]:
        return [layer for layer in self.memory if isinstance(layer, StackedLstm)]


class StackedLstm(nn.Module):
    """K LSTM layers as one, with gates in torch's order (input, forget, cell, output) and one bias each."""

    def __init__(self, copies: int, inputs: int, size: int) -> None:
        super().__init__()
        self.size = (copies, size)
        self.inputs = StackedLinear(copies, inputs, 4 * size)
        self.recurrent = nn.Parameter(torch.empty(copies, size, 4 * size))
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -1 / math.sqrt(size), 1 / math.sqrt(size))

    def forward(
        self, values: Tensor, batch: tuple[int, int], h: Tensor, c: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """[K, N · T, inputs] to [K, N · T, size], and h and c [N, K, size] after the last step."""
        if batch[1] == 1:
            return self._step(values, h.transpose(0, 1), c.transpose(0, 1))
        sequences = values.unflatten(1, batch).expand(self.size[0], -1, -1, -1)
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # of scattered weights, on GPUs
            each = [
                torch.lstm(sequence, own, weights, True, 1, 0.0, self.training, False, True)
                for sequence, own, weights in zip(sequences, self._states(h, c), self._weights(), strict=True)
            ]
        outputs, h, c = (torch.stack(parts) for parts in zip(*each, strict=True))
        return outputs.flatten(1, 2), h[:, 0].transpose(0, 1), c[:, 0].transpose(0, 1)

    def _step(self, values: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """A single step of all K at once, which can be exported.

        For many steps torch's own loop, copy by copy, takes a half to a fifth of the time (5 copies of size
        64 over 16 × 100 and 1 × 1000 steps).
        """
        gates = torch.baddbmm(self.inputs(values), h, self.recurrent)
        take, keep, new, give = gates.chunk(4, -1)
        c = keep.sigmoid() * c + take.sigmoid() * new.tanh()
        h = give.sigmoid() * c.tanh()
        return h, h.transpose(0, 1), c.transpose(0, 1)

    def _states(self, h: Tensor, c: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """h and c of each copy, [1, N, size]."""
        for copy in range(self.size[0]):
            yield h[None, :, copy].contiguous(), c[None, :, copy].contiguous()

    def _weights(self) -> Iterator[list[Tensor]]:
        for weight, bias, recurrent in zip(self.inputs.weight, self.inputs.bias, self.recurrent, strict=True):
            none = torch.zeros_like(bias[0])
            yield [weight.mT.contiguous(), recurrent.mT.contiguous(), bias[0], none]  # for GPUs


def _in_windows(
    layer: StackedLstm, values: Tensor, inputs: Inputs, h: Tensor, c: Tensor, horizon: int
) -> tuple[Tensor, Tensor, Tensor]:
    """A layer's outputs where each window of ``horizon`` steps of a trajectory begins with zeros.

    Windows that are complete in these inputs go through the layer together, as sequences.
    """
    trajectories, steps = inputs.batch
    if steps == 1:  # without a branch, which a program of one step cannot hold
        goes_on = (inputs.time % horizon != 0).to(h.dtype)
        return layer(values, inputs.batch, h * goes_on, c * goes_on)  # type: ignore[no-any-return]
    rest = min(-int(inputs.time[0]) % horizon, steps)  # of the window in which the first step lies
    whole, last = divmod(steps - rest, horizon)
    parts: list[Tensor] = []
    sequences = values.unflatten(1, (trajectories, steps)).split([rest, whole * horizon, last], dim=2)
    for seen, windows in zip(sequences, (1, whole, 1), strict=True):
        if size := seen.shape[2]:
            if parts or not rest:
                h = c = h.new_zeros(trajectories * windows, *h.shape[1:])
            said, h, c = layer(seen.flatten(1, 2), (trajectories * windows, size // windows), h, c)
            h, c = (state.unflatten(0, (trajectories, windows))[:, -1] for state in (h, c))
            parts.append(said.unflatten(1, (trajectories, size)))
    return torch.cat(parts, dim=2).flatten(1, 2), h, c
