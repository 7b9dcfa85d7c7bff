"""The gradient of a minibatch as the sum of those of its shards, in their order.

The sum of floating-point numbers depends on its order. A minibatch is therefore cut into a fixed number of shards
(``training.shards``), whatever the number of processes, and its gradient is summed in one order, whoever computed what.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.seeding import seed
from ddco_pyro.training.objective import Objective

Gradients = list[np.ndarray | None]
"""Of each parameter; None where there is none."""


@dataclass(frozen=True)
class Shard:
    """A part of a minibatch: its training demonstrations ``rows`` [M], and the seed of what is random in it; None to go
    on with the epoch's random numbers.
    """

    rows: Tensor
    seed: int | None


def cut(rows: Tensor, count: int, seed: Callable[[int], int]) -> list[Shard]:
    """A minibatch in so many shards, as equal as they can be; of fewer demonstrations a shard for each.

    :param seed: of a shard, by its number. A single shard needs none.
    """
    if count == 1:
        return [Shard(rows, None)]
    parts = rows.tensor_split(min(count, len(rows)))
    return [Shard(part, seed(number)) for number, part in enumerate(parts)]


def ascend(
    objective: Objective,
    model: Hierarchy,
    parameters: Sequence[nn.Parameter],
    shards: Sequence[Shard],
    steps: int,
) -> float:
    """Give the parameters the gradient of a minibatch's loss; what the minibatch adds to what is maximised.

    A parameter that no shard has a gradient of has none.

    :param steps: of the whole minibatch: its loss is minus what is maximised, divided by them.
    """
    total = 0.0
    sums: Gradients = [None] * len(parameters)
    parts = (partial(_part, objective, model, parameters, shard, steps) for shard in shards)
    for value, gradients in objective.ranks.each(parts):
        total += value
        sums = [_sum(*pair) for pair in zip(sums, gradients, strict=True)]
    for parameter, gradient in zip(parameters, sums, strict=True):
        parameter.grad = None if gradient is None else torch.from_numpy(gradient).to(parameter.device)
    return total


def _part(
    objective: Objective, model: Hierarchy, parameters: Sequence[nn.Parameter], shard: Shard, steps: int
) -> tuple[float, Gradients]:
    """What a shard adds to what is maximised, and to the gradient of each parameter."""
    for parameter in parameters:
        parameter.grad = None
    if shard.seed is not None:
        seed(shard.seed, model.device)
    value = objective.ascend(model, shard.rows, steps)
    return value, [None if parameter.grad is None else parameter.grad.cpu().numpy() for parameter in parameters]


def _sum(before: np.ndarray | None, gradient: np.ndarray | None) -> np.ndarray | None:
    if before is None or gradient is None:
        return gradient if before is None else before
    before += gradient
    return before
