"""Use of the branches of a network: activation, and loss in log-likelihood when the input is shuffled (SM 1.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from ddco_pyro.evaluation.inferred import Inferred
from ddco_pyro.inference.posteriors import log_predictive
from ddco_pyro.metrics import BranchUse
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks import Inputs
from ddco_pyro.model.networks.perceptrons import Branches

SEED = 0
"""The seed of the permutation of steps."""


def branch_use(hierarchy: Hierarchy, pieces: Iterable[Inferred]) -> list[BranchUse]:
    """The use of branches in each level whose policies have branches, lowest first, the meta-policy last.

    ``level`` is the number of the level from 0, ``branches`` has the names of the branches. Two tables have a row for
    each option and a column for each branch, weighted by the posterior probability that the option is active:

    - ``activation``: the mean absolute value of the branch's output;
    - ``loss``: the loss in nats per step, of the option's control or the meta-policy's choices, where the branch reads
      the observation of a random other step; None where the level emits no control.
    """
    branched = _branched(hierarchy)
    if not branched:
        return []
    sums: dict[tuple[int, int], Tensor] = {}
    for piece in pieces:
        for level, network in branched.items():
            for number, branch in enumerate(network.of):
                own = _sums(hierarchy, piece, level, branch)
                sums[level, number] = sums.get((level, number), torch.zeros(1)) + own
    return [
        BranchUse(
            level=level,
            branches=list(network.names),
            activation=_rows(sums, level, len(network.of), 0),
            loss=_rows(sums, level, len(network.of), 1),
        )
        for level, network in branched.items()
    ]


def _branched(hierarchy: Hierarchy) -> dict[int, Branches]:
    """The branches that each level's policies read, by level; the meta-policy is the last level."""
    by_level: dict[int, Branches] = {}
    for place, network in hierarchy.networks().items():
        inside = [module for module in network.modules() if isinstance(module, Branches)]
        if inside and not place.endswith("termination"):
            for level in _levels(place, hierarchy.depth):
                by_level.setdefault(level, inside[0])
    return dict(sorted(by_level.items()))


def _levels(place: str, depth: int) -> Iterable[int]:
    """The levels that a network of the hierarchy belongs to; the trunk belongs to all."""
    if place == "trunk":
        return range(depth + 1)
    return (depth,) if place == "meta_policy" else (int(place.split(".")[1]),)


def _rows(sums: dict[tuple[int, int], Tensor], level: int, branches: int, what: int) -> list[list[float | None]]:
    """Means by option and branch; None where an option is never active, or emits no control."""
    columns = [sums[level, number][:, what] / sums[level, number][:, 2] for number in range(branches)]
    values = torch.stack(columns, dim=1).tolist()
    return [[None if math.isnan(value) else value for value in row] for row in values]


def _sums(hierarchy: Hierarchy, piece: Inferred, level: int, branch: nn.Module) -> Tensor:
    """Weighted sums of activation, loss and weight over the steps, [K, 3]."""
    weight = _weight(hierarchy, piece, level)
    seen: list[Tensor] = []  # [N, T, K, F] for each chunk of time
    with torch.no_grad():
        with branch.register_forward_hook(lambda _, __, output: seen.append(output[0].cpu())):
            hierarchy(piece.batch.inputs)
        activation = torch.cat(seen, dim=1).double().abs().mean(-1)
        with branch.register_forward_pre_hook(partial(_shuffled, piece.batch.lengths)):
            loss = _score(hierarchy, piece, level, weight) - _score(hierarchy, piece, level, weight, replaced=True)
    return torch.stack([(weight * activation).sum((0, 1)), loss, weight.sum((0, 1))], dim=-1)


def _weight(hierarchy: Hierarchy, piece: Inferred, level: int) -> Tensor:
    """The posterior probability that each of a level's callers is active, [N, T, K]."""
    if level < hierarchy.depth:
        return piece.posterior.u[level][..., 1:]
    alive = torch.arange(piece.batch.inputs.batch[1]) < piece.batch.lengths[:, None]
    return alive.double().unsqueeze(-1)


def _score(hierarchy: Hierarchy, piece: Inferred, level: int, weight: Tensor, replaced: bool = False) -> Tensor:
    """The weighted log-density of each caller's control; for the meta-policy the whole log-likelihood, [K]."""
    outputs = hierarchy(piece.batch.inputs) if replaced else piece.outputs
    if level == hierarchy.depth:
        return log_predictive(outputs.tables(piece.batch.actions), piece.batch.lengths).sum().reshape(1)
    emission = outputs.emissions[level]
    if emission is None:
        return torch.full((weight.shape[-1],), torch.nan, dtype=torch.float64)
    density = emission.log_density(piece.batch.actions).double()
    return torch.where(weight > 0, weight * density, 0.0).sum((0, 1))


def _shuffled(lengths: Tensor, branch: nn.Module, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments of a branch, with the observations of a chunk of time in a random order."""
    inputs: Inputs = arguments[0]
    device = inputs.time.device
    alive = inputs.time < lengths[:, None].to(device)
    order = torch.randperm(int(alive.sum()), generator=torch.Generator().manual_seed(SEED)).to(device)

    def shuffled(array: Tensor) -> Tensor:
        changed = array.clone()
        changed[alive] = array[alive][order]
        return changed

    return (inputs.map(shuffled, inputs.time), *arguments[1:])
