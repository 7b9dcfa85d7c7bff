"""Use of the branches of a network: activation, and loss in log-likelihood under shuffled input (SM 1.4)."""

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
from ddco_pyro.model.outputs import Outputs

SEED = 0
"""The seed of the permutation of steps."""


def branch_use(hierarchy: Hierarchy, pieces: Iterable[Inferred]) -> list[BranchUse]:
    """The use of branches in each level whose policies have branches, lowest first, the meta-policy last.

    ``level`` is the number of the level from 0, ``branches`` has the names of the branches. Two tables have a
    row for each option and a column for each branch, weighted by the probability that the option is active:

    - ``activation``: the mean absolute value of the branch's output;
    - ``loss``: the loss in nats per step, of the option's control or the meta-policy's choices, where the
      branch reads the observation of a random other step; None where the level emits no control.
    """
    branched = _branched(hierarchy)
    sums: dict[int, Tensor] = {}
    for piece in pieces if branched else ():
        for level, network in branched.items():
            own = torch.stack([_sums(piece, level, branch) for branch in network.of], dim=1)
            sums[level] = own + sums.get(level, 0.0)
    found = []
    for level, network in branched.items():
        tables = (sums[level][..., :2] / sums[level][..., 2:]).permute(2, 0, 1).tolist()
        known = ([[None if math.isnan(x) else x for x in row] for row in table] for table in tables)
        activation, loss = known
        found.append(BranchUse(level=level, branches=list(network.names), activation=activation, loss=loss))
    return found


def _branched(hierarchy: Hierarchy) -> dict[int, Branches]:
    """The branches that each level's policies read; the meta-policy is the last level, a trunk is of all."""
    by_level: dict[int, Branches] = {}
    for place, network in hierarchy.networks().items():
        inside = next((module for module in network.modules() if isinstance(module, Branches)), None)
        if inside is not None and not place.endswith("termination"):
            own = hierarchy.depth if place in ("trunk", "meta_policy") else int(place.split(".")[1])
            for level in range(own + 1) if place == "trunk" else (own,):
                by_level.setdefault(level, inside)
    return dict(sorted(by_level.items()))


def _sums(piece: Inferred, level: int, branch: nn.Module) -> Tensor:
    """Over steps, of each caller of a level: activation and loss of a branch, weighted, and weights, [K, 3].

    A weight is the posterior probability that the caller is active.
    """
    hierarchy, inputs, lengths = piece.hierarchy, piece.batch.inputs, piece.batch.lengths
    inner = level < hierarchy.depth
    weight = piece.posterior.u[level][..., 1:] if inner else piece.batch.alive.double().unsqueeze(-1)
    seen: list[Tensor] = []  # [N, T, K, F] for each chunk of time
    with torch.no_grad():
        with branch.register_forward_hook(lambda _, __, output: seen.append(output[0].cpu())):
            hierarchy(inputs)
        activation = torch.cat(seen, dim=1).double().abs().mean(-1)
        with branch.register_forward_pre_hook(partial(_shuffled, lengths)):
            replaced = hierarchy(inputs)
        loss = _score(piece, piece.outputs, level, weight) - _score(piece, replaced, level, weight)
    return torch.stack([(weight * activation).sum((0, 1)), loss, weight.sum((0, 1))], dim=-1)


def _score(piece: Inferred, outputs: Outputs, level: int, weight: Tensor) -> Tensor:
    """The weighted log-density of each caller's control; of the meta-policy the whole log-likelihood, [K]."""
    if level == piece.hierarchy.depth:
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
