"""Gradient steps of a stage of training: the optimiser, its learning rate, and the running mean of the weights."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import nn

from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import OptimizerSpec, TrainingSpec
from ddco_pyro.training.averaging import Average
from ddco_pyro.training.checkpoint import State, copy_of, optimizer_state, restore_optimizer
from ddco_pyro.training.objective import Objective
from ddco_pyro.training.shards import Shard, ascend
from ddco_pyro.training.stages import Stage


class Ascent:
    """Gradient steps of a stage: what they change, and by what.

    :ivar average: the model that is evaluated and kept.
    """

    def __init__(self, model: Hierarchy, stage: Stage, spec: TrainingSpec, objective: Objective) -> None:
        self.model, self.objective = model, objective
        self._parameters = [p for name, p in model.named_parameters() if name.startswith(stage.trained)]
        self._optimizer, self._clip = _optimizer(spec.optimizer, self._parameters), spec.clip_gradient
        self.average = Average.of(model, spec.average)

    def set_rate(self, rate: float) -> None:
        """The learning rate from here on."""
        for group in self._optimizer.param_groups:
            group["lr"] = rate

    def step(self, shards: Sequence[Shard], steps: int) -> float:
        """A gradient step on a minibatch of so many steps; its log-likelihood before."""
        value = ascend(self.objective, self.model, self._parameters, shards, steps)
        if self._clip is not None:
            nn.utils.clip_grad_norm_(self._parameters, self._clip)
        self._optimizer.step()
        self.average.update(self.model)
        return value

    def states(self) -> dict[str, State]:
        """What a checkpoint needs of it."""
        return {
            "model": copy_of(self.model),
            "optimizer": optimizer_state(self._optimizer),
            **self.average.states(),
        }

    def restore(self, states: dict[str, State]) -> None:
        """As :meth:`states` was; the model itself is as it was already."""
        restore_optimizer(self._optimizer, states["optimizer"])
        self.average.restore(states)


def learning_rate(spec: OptimizerSpec, epoch: int, cap: int | None) -> float:
    """The learning rate of a stage's epoch, counted from 0.

    :param cap: the epochs that the stage may take.
    """
    rate = spec.lr * min(1.0, (epoch + 1) / (spec.warmup + 1))
    if spec.schedule == "constant":
        return rate
    assert cap is not None  # a spec with this schedule has a budget
    return rate * 0.5 * (1 + math.cos(math.pi * epoch / cap))


def _optimizer(spec: OptimizerSpec, parameters: list[nn.Parameter]) -> torch.optim.Optimizer:
    if spec.name == "momentum":
        return torch.optim.SGD(parameters, lr=spec.lr, momentum=spec.momentum, weight_decay=spec.weight_decay)
    kind = torch.optim.AdamW if spec.name == "adamw" else torch.optim.Adam
    return kind(parameters, lr=spec.lr, weight_decay=spec.weight_decay)
