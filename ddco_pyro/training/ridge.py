"""The ridge of policies, raised where left-out training demonstrations show that it is too small."""

from __future__ import annotations

import torch
from torch import Tensor

from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.networks.perceptrons import Mlp
from ddco_pyro.training.em import BIAS
from ddco_pyro.training.initialization import Clusters

RAISED = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""The ridges that are tried, in units of the spec's own."""
FOLDS = 5
"""The parts into which training demonstrations are divided, each left out in turn."""
ENOUGH = 0.5
"""Nats per step: a ridge is large enough where no other gains more. Larger ones give policies that act worse."""
LEAST = 0.01
"""σ of a policy, at least, in units of each dimension's spread."""


def cross_validated(model: Hierarchy, batch: Batch, ridge: float, seed: int) -> float:
    """The smallest of the ridges :data:`RAISED` that is large enough for the policies of a linear hierarchy.

    For each cluster of observations and controls, as many as the lowest level has options, ridge regression predicts
    the continuous controls of demonstrations that are left out. EM begins from such regressions.

    :param batch: the training demonstrations; one alone leaves nothing to predict.
    :param ridge: the spec's own.
    """
    scaling = model.scaling
    dims = [dim for own, part in zip(scaling.groups, scaling.parts, strict=True) if part.continuous for dim in own]
    (policy, *_), count = model.networks().values(), model.option_levels()[0].count if model.depth else 1
    assert isinstance(policy, Mlp)  # EM trains no other
    if len(batch) < 2 or not dims or not ridge or not policy.reads:
        return ridge
    given = batch.inputs.select(policy.reads).vector.double()
    x = torch.cat([given, given.new_ones(*given.shape[:-1], 1)], dim=-1)
    alive = batch.alive
    clusters = Clusters(batch, count, seed, controls=True, read=policy.reads).choices(batch) if count > 1 else alive
    fold = (torch.arange(len(batch)) % min(FOLDS, len(batch))).unsqueeze(1)
    ridges = ridge * torch.tensor(RAISED, dtype=torch.float64)
    total = torch.zeros_like(ridges)
    for left_out in fold.unique():
        for cluster in range(1, count + 1):
            inside = alive & (clusters == cluster)
            parts = inside & (fold != left_out), inside & (fold == left_out)
            rows = [(x[where], batch.actions[where][:, dims].double()) for where in parts]
            total += _score(*rows[0], *rows[1], ridges)
    values = total / batch.steps
    return float(ridges[int((values >= values.max() - ENOUGH).nonzero()[0])])


def _score(x: Tensor, actions: Tensor, others: Tensor, their: Tensor, ridges: Tensor) -> Tensor:
    """The log-likelihood of left-out controls under regressions with each of R ridges, up to a constant, [R] nats."""
    prior = ridges.unsqueeze(-1).repeat(1, x.shape[-1])
    prior[:, -1] = BIAS
    weight = torch.linalg.solve(x.T @ x + torch.diag_embed(prior), x.T @ actions)  # [R, F, A]
    square = (actions - x @ weight).square().sum(1) + (prior.unsqueeze(-1) * weight.square()).sum(1)
    std = (square / max(len(x) + x.shape[-1] - 1, 1)).sqrt().clamp(min=LEAST)
    error = (their - others @ weight) / std.unsqueeze(1)
    return -0.5 * error.square().sum((1, 2)) - len(their) * std.log().sum(1)
