"""Expectation-gradient training (paper §4.1) in stages (SM 2.2, SM 2.3), with restarts, early stopping and checkpoints.

The gradient of the marginal log-likelihood *is* the expectation-gradient step: the E-step's posteriors weight the
networks' gradients. A gradient step sees a minibatch of whole trajectories.

Everything random in an epoch is seeded by (seed, restart, stage, epoch), so a run that was interrupted and resumed from
the end of any epoch gives the same result, bit for bit, as one that was not. Checkpoints are of ends of epochs.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.events import EpochEnded, OnEvent, ignore
from ddco_pyro.fitting.building import Dimensions, build_hierarchy
from ddco_pyro.fitting.convergence import StageEnd, share, summary
from ddco_pyro.fitting.objective import Objective
from ddco_pyro.fitting.stages import WHOLE, Stage, plan
from ddco_pyro.model.encoding import encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import OptimizerSpec, Spec

SAVE_EVERY = 1.0  # s between checkpoints, at least: an epoch of a small model takes less time than its checkpoint

State = dict[str, Tensor]


@dataclass
class Progress:
    """Where training stands at the end of an epoch; with the tensors of a checkpoint it is all that is needed.

    ``start`` is the tuning log-likelihood per step from before this stage, ``best`` that of its best epoch, ``winner``
    that of the best finished restart. ``ended`` has a :class:`StageEnd` for each stage of this restart that has ended,
    ``winner_ended`` those of the best finished restart.
    """

    restart: int = 0
    stage: int = 0
    epoch: int = 0
    stale: int = 0
    start: float = -np.inf
    best: float = -np.inf
    winner: float = -np.inf
    ended: list[dict[str, Any]] = field(default_factory=list)
    winner_ended: list[dict[str, Any]] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)


class Trainer:
    """Trains a spec's hierarchy on ``train``, stopping and choosing among restarts by ``tune``.

    ``first`` is the hierarchy before any training.

    :param checkpoint: where the state is kept at the end of epochs; None for a training too short to be continued.
    :raises DemonstrationsError: a number is too large for networks.
    """

    def __init__(
        self,
        spec: Spec,
        dimensions: Dimensions,
        train: Demonstrations,
        tune: Demonstrations,
        checkpoint: Path | None = None,
        on_event: OnEvent = ignore,
    ) -> None:
        self.spec, self.dimensions, self.checkpoint, self.on_event = spec, dimensions, checkpoint, on_event
        self.progress = Progress()
        self._saved: dict[str, State] = {}
        self._saved_at = -np.inf  # the first epoch is saved
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(spec.seed)
            self.first = build_hierarchy(spec, dimensions)  # its encoder and scaling are those of all restarts
        self.first.encoder.fit(train)
        self.first.scaling.fit(train)
        self.names = train.names
        self.train, self.tune = (encode(part, self.first.encoder, self.first.scaling) for part in (train, tune))

    def run(self) -> Hierarchy:
        """The best restart's hierarchy, in evaluation mode.

        :raises TrainingError: where a log-likelihood is not finite.
        """
        self._load()
        model = self._fresh()
        stages = plan(self.spec, model.depth)
        while self.progress.restart < self.spec.training.restarts:
            if self.progress.stage == 0 and self.progress.epoch == 0:
                model = self._fresh()
            while self.progress.stage < len(stages):
                self._run_stage(model, stages[self.progress.stage], len(stages) - self.progress.stage)
                self.progress.stage += 1
            self._finish_restart(model)
        model.load_state_dict(self._saved["winner"])
        return model.eval()

    @property
    def summary(self) -> dict[str, Any]:
        """How the best restart was trained, for ``metrics.json``."""
        ends = [StageEnd(**end) for end in self.progress.winner_ended]
        return summary(self.spec.training, ends, math.ceil(len(self.train) / self.spec.training.batch_size))

    def _fresh(self) -> Hierarchy:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._seed(self.progress.restart))
            hierarchy = build_hierarchy(self.spec, self.dimensions)
        hierarchy.encoder.load_state_dict(self.first.encoder.state_dict())
        hierarchy.scaling.load_state_dict(self.first.scaling.state_dict())
        return hierarchy.eval()

    def _seed(self, *where: int) -> int:
        return int(np.random.SeedSequence([self.spec.seed, *where]).generate_state(1)[0])

    def _run_stage(self, model: Hierarchy, stage: Stage, stages_left: int) -> None:
        now, training = self.progress, self.spec.training
        cap = share(training.epochs, sum(end["epochs"] for end in now.ended), stages_left)
        objective = Objective(self, stage)
        parameters = [p for name, p in model.named_parameters() if name.startswith(stage.trained)]
        optimizer = _optimizer(training.optimizer, parameters)
        if now.epoch > 0:
            model.load_state_dict(self._saved["model"])
            _restore_optimizer(optimizer, self._saved["optimizer"])
        else:
            now.start, now.stale = objective.tune(model), 0
            now.best = now.start
            self._saved["best"] = _copy(model)
        while (cap is None or now.epoch < cap) and (training.patience is None or now.stale < training.patience):
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(training.optimizer, now.epoch, cap)
            train = self._epoch(model, optimizer, parameters, objective)
            self._record(stage, train, objective.tune(model), model)
            if time.monotonic() - self._saved_at > SAVE_EVERY:
                self._save(model, optimizer)
        model.load_state_dict(self._saved["best"])
        tune = [now.start, *(row["tune"] for row in now.history[len(now.history) - now.epoch :])]
        now.ended.append(asdict(StageEnd.of(stage.name, cap, tune, training.patience)))
        now.epoch = 0

    def _epoch(
        self, model: Hierarchy, optimizer: torch.optim.Optimizer, parameters: list[nn.Parameter], objective: Objective
    ) -> float:
        """One pass over the training demonstrations; the log-likelihood per step seen on the way."""
        now, total = self.progress, 0.0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._seed(now.restart, now.stage, now.epoch))
            model.train()
            for rows in torch.randperm(len(self.train)).split(self.spec.training.batch_size):
                optimizer.zero_grad(set_to_none=True)
                total += objective.ascend(model, rows)
                if self.spec.training.clip_gradient is not None:
                    nn.utils.clip_grad_norm_(parameters, self.spec.training.clip_gradient)
                optimizer.step()
            model.eval()
        return total / self.train.steps

    def _record(self, stage: Stage, train: float, tune: float, model: Hierarchy) -> None:
        now = self.progress
        now.epoch += 1
        if tune > now.best:
            now.best, now.stale = tune, 0
            self._saved["best"] = _copy(model)
        else:
            now.stale += 1
        row = EpochEnded(now.restart, stage.name, now.epoch, train, tune)
        now.history.append(asdict(row))
        self.on_event(row)

    def _finish_restart(self, model: Hierarchy) -> None:
        now = self.progress
        value = Objective(self, WHOLE).tune(model)
        if "winner" not in self._saved or value > now.winner:
            now.winner, now.winner_ended = value, now.ended
            self._saved["winner"] = _copy(model)
        now.restart, now.stage, now.epoch, now.ended = now.restart + 1, 0, 0, []
        self._save(model, None)

    def _save(self, model: Hierarchy, optimizer: torch.optim.Optimizer | None) -> None:
        if self.checkpoint is None:
            return
        self._saved_at = time.monotonic()
        self._saved["model"] = _copy(model)
        self._saved["optimizer"] = {} if optimizer is None else _optimizer_state(optimizer)
        tensors = {f"{part}/{name}": value for part, state in self._saved.items() for name, value in state.items()}
        write_tensors(self.checkpoint, tensors, {"progress": json.dumps(asdict(self.progress))})

    def _load(self) -> None:
        if self.checkpoint is None or not self.checkpoint.exists():
            return
        remedy = "remove it and do the same again: training begins anew"
        tensors, metadata = read_tensors(self.checkpoint, remedy)
        self.progress = Progress(**json.loads(metadata["progress"]))
        self._saved = {"optimizer": {}}
        for name, value in tensors.items():
            part, _, rest = name.partition("/")
            self._saved.setdefault(part, {})[rest] = value


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
    if spec.name == "adam":
        return torch.optim.Adam(parameters, lr=spec.lr, weight_decay=spec.weight_decay)
    return torch.optim.SGD(parameters, lr=spec.lr, momentum=spec.momentum, weight_decay=spec.weight_decay)


def _copy(model: nn.Module) -> State:
    return {name: value.detach().clone() for name, value in model.state_dict().items()}


def _optimizer_state(optimizer: torch.optim.Optimizer) -> State:
    """The optimiser's tensors by ``<parameter>.<name>``."""
    state = optimizer.state_dict()["state"]
    return {
        f"{index}.{name}": torch.as_tensor(value).clone()
        for index, values in state.items()
        for name, value in values.items()
        if value is not None
    }


def _restore_optimizer(optimizer: torch.optim.Optimizer, state: State) -> None:
    nested: dict[int, State] = {}
    for key, value in state.items():
        index, _, name = key.partition(".")
        nested.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), "state": nested})
