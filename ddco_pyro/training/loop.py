"""The training loop of one restart (paper §4.1, SM 2.2, SM 2.3): stages, epochs, steps, early stopping.

The gradient of the marginal log-likelihood *is* the expectation-gradient step: the posteriors of the E-step
weight the gradients of the networks. A gradient step sees a minibatch of whole trajectories.

The random numbers of an epoch are seeded by (seed, restart, stage, epoch). Gradient steps that are continued
from the end of any epoch, in this process or another, therefore have the same bits as without an
interruption. The gradients of a minibatch's shards (``training.shards``) are added in the order of the
shards, so that the number of processes that compute them changes no bit either.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from ddco_pyro.events import EpochEnded, OnEvent, ignore
from ddco_pyro.model.batch import Batch, Parts
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.seeding import seed as seed_generators
from ddco_pyro.model.seeding import seeded
from ddco_pyro.training.checkpoint import Restart, State, TrainingData, copy_of
from ddco_pyro.training.em import Expectation
from ddco_pyro.training.objective import Diverged, Objective
from ddco_pyro.training.optimizers import (
    QuasiNewton,
    gradient_optimizer,
    learning_rate,
    optimizer_of,
    optimizer_state,
    restore_optimizer,
)
from ddco_pyro.training.processes import Ranks, device_of, one_thread, repeatable
from ddco_pyro.training.stages import EVERYTHING, Stage, plan, share, stage_end

SAVE_EVERY = 5.0
"""Seconds between checkpoints, at least: an epoch of a small model takes less time than its checkpoint."""

Gradients = list[np.ndarray | None]
"""The gradient of each parameter; None for a parameter without one."""


def train(
    data: TrainingData,
    restart: Restart,
    until: int | None = None,
    checkpoint: Path | None = None,
    on_event: OnEvent = ignore,
) -> Restart:
    """Train a restart further, on one thread, together with the processes of ``torchrun``
    (:meth:`Ranks.here`).

    :param until: epochs of the last stage after which training pauses; None to train until patience or budget
        end it. A restart whose steps are over all demonstrations goes on from there in this process alone.
    :param checkpoint: the file that the restart is written to, at the end of epochs of gradient steps and of
        the training. Steps over all demonstrations take seconds: those of a stage are made again after an
        interruption.
    """
    now, states, spec = restart.progress, restart.states, data.spec.training
    saved = -math.inf
    with one_thread(), repeatable(device_of(spec)):
        model = data.hierarchy(now.restart, states.get("model"))
        stages = plan(data.spec, model.depth, now.restart)
        try:
            while not now.done:
                last = now.stage == len(stages) - 1
                cap = share(spec.epochs, now.spent, len(stages) - now.stage)
                stage = restart.paused or StageTraining(data, model, stages[now.stage], restart, last)
                restart.paused = None
                while (cap is None or now.epoch < cap) and not stage.converged:
                    if last and until is not None and now.epoch >= until:
                        now.sounded = stage.reached()
                        if stage.whole is not None:
                            restart.paused, stage.whole.parts = stage, []  # cut again where it goes on
                            return restart
                        states |= stage.states()
                        return restart.written(checkpoint)
                    on_event(stage.epoch(cap))
                    if checkpoint and stage.whole is None and time.monotonic() - saved > SAVE_EVERY:
                        states |= stage.states()
                        restart.written(checkpoint)
                        saved = time.monotonic()
                stage.end(cap)
                if last:
                    now.objective = stage.reached()
                    if until is not None:
                        now.sounded = now.objective
                after = (now.stage, now.epoch, True) if last else (now.stage + 1, 0, False)
                now.stage, now.epoch, now.done = after
            restart.states = {"best": states["best"]}
        except Diverged as error:
            now.done, now.diverged, restart.states = True, str(error), {}
            now.best = now.objective = -math.inf
    return restart.written(checkpoint)


class StageTraining:
    """A stage of a restart in training: model, objective, optimiser, and running mean of the weights.

    The stage begins, or goes on from the restart's checkpoint. Tuning demonstrations end it and choose its
    epoch; EM before the last stage goes on until it converges instead, since a stage starts the next one.

    :param last: whether it is the last stage of the restart.
    :ivar whole: steps over all demonstrations at once; None for gradient steps on minibatches.
    :ivar kept: the model that is evaluated and kept: the exponential running mean of the weights over
        gradient steps (Polyak and Juditsky 1992) where ``training.average`` asks for it, the trained model
        otherwise.
    """

    def __init__(
        self, data: TrainingData, model: Hierarchy, stage: Stage, restart: Restart, last: bool
    ) -> None:
        self.data, self.model, self.stage = data, model, stage
        self.restart, self.ranks = restart, Ranks.here()
        self.spec, self.last, now = data.spec.training, last, restart.progress
        if stage.memoryless:
            model.begin_terminations()
        self.objective = Objective(data, now, stage, restart.states if now.epoch else None)
        self.parameters = [p for name, p in model.named_parameters() if name.startswith(stage.trained)]
        self.whole: Expectation | QuasiNewton | None = None
        optimizer = optimizer_of(self.spec.optimizer, model)
        if optimizer == "em":
            settings = (self.spec.optimizer.ridge, stage.discovering, not last, data.library)
            self.whole = Expectation(model, stage.trained, self.objective.score, *settings)
        elif optimizer == "lbfgs":
            gradient = partial(backward, self.objective)
            self.whole = QuasiNewton(model, gradient, self.spec.optimizer.weight_decay)
        else:
            self.optimizer = gradient_optimizer(optimizer, self.spec.optimizer, self.parameters)
        decay = self.spec.average
        self.mean = None if decay is None else AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(decay))
        if now.epoch > 0:
            restore_optimizer(self.optimizer, restart.states["optimizer"])
            if self.mean is not None:
                self.mean.load_state_dict(restart.states["average"])
        else:
            self.objective.find_constants(model)
            restart.states |= self.objective.states()
            now.start, now.stale = self.objective.tune(model), 0
            now.best = now.start
            restart.states["best"] = copy_of(model)

    @property
    def converged(self) -> bool:
        """Whether patience has run out, or a step over all demonstrations gains nothing more."""
        patience = self.spec.patience if self._tuned else None
        return self._at_optimum or (patience is not None and self.restart.progress.stale >= patience)

    @property
    def _at_optimum(self) -> bool:
        return self.whole is not None and self.whole.converged

    @property
    def _tuned(self) -> bool:
        """Whether tuning demonstrations end the stage and choose its epoch."""
        return self.whole is None or self.last

    @property
    def kept(self) -> Hierarchy:
        if self.mean is None:
            return self.model
        mean = self.mean.module
        assert isinstance(mean, Hierarchy)  # a copy of the model
        return mean.eval()

    def epoch(self, cap: int | None) -> EpochEnded:
        """One pass over the training demonstrations, and what it gained on the tuning demonstrations.

        :param cap: the epochs that the stage may take.
        """
        now, train = self.restart.progress, self.data.train
        place, steps = (now.restart, now.stage, now.epoch), train.steps
        if self.whole is not None:
            total = self.whole.step(train) / self.objective.likelihoods
            steps = self.whole.steps
        else:
            for group in self.optimizer.param_groups:
                group["lr"] = learning_rate(self.spec.optimizer, now.epoch, cap)
            total = self._gradient_steps(place)
        tune = self.objective.tune(self.kept)
        now.epoch += 1
        if tune > now.best or not self._tuned:
            now.best, now.stale = tune, 0
            self.restart.states["best"] = copy_of(self.kept)
        else:
            now.stale += 1
        ended = EpochEnded(now.restart, self.stage.name, now.epoch, total / steps, tune)
        now.history.append(asdict(ended))
        return ended

    def _gradient_steps(self, place: tuple[int, int, int]) -> float:
        """A gradient step on each minibatch; the log-likelihood on the way, nats.

        :param place: the restart, stage and epoch, which seed what is random.
        """
        train, total = self.data.train, 0.0
        varied = train.varied(self.model.encoder.shifts, self.data.seed(*place))
        with seeded(self.data.seed(*place), self.model.device):
            self.model.train()
            minibatches = torch.randperm(len(train)).split(self.spec.batch_size)
            for number, rows in enumerate(minibatches):
                total += self.step(varied, rows, number)
            self.model.eval()
        return total

    def step(self, batch: Batch, rows: Tensor, number: int) -> float:
        """A gradient step on a minibatch; the log-likelihood of the minibatch before it, nats.

        :param rows: the training demonstrations of the minibatch, [M].
        :param number: of the minibatch in its epoch.
        """
        self.optimizer.zero_grad()
        if self.spec.shards == 1:
            value = backward(self.objective, self.model, batch.parts(rows, self.model.steps_at_once))
        else:
            value = self._backward_in_shards(batch, rows, number)
        self.optimizer.step()
        if self.mean is not None:
            self.mean.update_parameters(self.model)
        return value

    def _backward_in_shards(self, batch: Batch, rows: Tensor, number: int) -> float:
        """:func:`backward`, shard after shard; the processes take turns in computing them."""
        steps, at, total = int(batch.lengths[rows].sum()), self.restart.progress, 0.0
        sums: Gradients = [None] * len(self.parameters)
        seed = partial(self.data.seed, at.restart, at.stage, at.epoch, number)
        parts = rows.tensor_split(min(self.spec.shards, len(rows)))  # none is empty
        shards = (partial(self._shard, batch, part, seed(shard), steps) for shard, part in enumerate(parts))
        for value, gradients in self.ranks.each(shards):
            total += value
            pairs = zip(sums, gradients, strict=True)
            sums = [old if new is None else new if old is None else old + new for old, new in pairs]
        for parameter, gradient in zip(self.parameters, sums, strict=True):
            parameter.grad = None if gradient is None else torch.from_numpy(gradient).to(parameter.device)
        return total

    def _shard(self, batch: Batch, rows: Tensor, seed: int, steps: int) -> tuple[float, Gradients]:
        """The part of a shard in the objective, and in the gradient of each parameter.

        :param seed: of the shard's random numbers.
        """
        self.optimizer.zero_grad()
        seed_generators(seed, self.model.device)
        parts = batch.parts(rows, self.model.steps_at_once)
        value = backward(self.objective, self.model, parts, steps)
        return value, [None if p.grad is None else p.grad.cpu().numpy() for p in self.parameters]

    def states(self) -> dict[str, State]:
        """The state of gradient steps in a checkpoint, beside the best epoch and the objective."""
        average = {} if self.mean is None else {"average": copy_of(self.mean)}
        return {"model": copy_of(self.model), "optimizer": optimizer_state(self.optimizer), **average}

    def reached(self) -> float:
        """The objective of the training demonstrations under the best epoch's model, with the log-prior of
        the ridges where EM trains it, nats per step.
        """
        train, restart = self.data.train, self.restart
        model = self.data.hierarchy(restart.progress.restart, restart.states["best"])
        library, score = self.data.library, 0.0
        with torch.no_grad():
            for rows, piece in train.pieces(model.steps_at_once):
                tables = self.objective.tables(model, piece, rows)
                score += float(self.objective.values(tables, piece.lengths).sum())
            if library is not None and not isinstance(self.whole, Expectation):
                score += float(library.log_density(model))
        if isinstance(self.whole, Expectation):
            ridge = self.spec.optimizer.ridge
            whole = Expectation(model, EVERYTHING, self.objective.score, ridge, prior=library)
            score += whole.log_prior(train.select(torch.tensor([0])))
        return score / train.steps

    def end(self, cap: int | None) -> None:
        """The best epoch is the model that the stage gives."""
        now = self.restart.progress
        self.model.load_state_dict(self.restart.states["best"])
        now.ended.append(stage_end(self.stage.name, cap, now.tune, self.spec.patience, self._at_optimum))


def backward(objective: Objective, model: Hierarchy, parts: Parts, steps: int | None = None) -> float:
    """Add the gradient of the loss of some demonstrations to the parameters' gradients.

    The loss is minus the objective per step, and minus the log-prior of a library per step of all training
    demonstrations.

    :param parts: the demonstrations in pieces, each with its rows.
    :param steps: of the minibatch of which the demonstrations are a shard; None where they are all of it.
    :returns: what the demonstrations add to the objective, nats.
    :raises Diverged: the objective is not finite.
    """
    own, total = sum(piece.steps for _, piece in parts), 0.0
    for rows, piece in parts:
        tables = objective.tables(model, piece, rows)  # networks → tables
        value = objective.values(tables, piece.lengths).sum()  # exact log-likelihood, all options summed out
        if not bool(torch.isfinite(value.detach())):
            raise objective.diverged(tables, piece.lengths, rows)
        (-value / (steps or own)).backward()  # posteriors weight the networks' gradients
        total += float(value.detach())
    if (library := objective.data.library) is not None:
        share = own / objective.data.train.steps  # of the prior, which all demonstrations have once
        prior = share * library.log_density(model)
        (-prior / (steps or own)).backward()  # type: ignore[no-untyped-call]
        total += float(prior.detach())
    return total / objective.likelihoods
