"""Expectation-gradient training (paper §4.1) of a restart, in stages (SM 2.2, SM 2.3), with early stopping.

The gradient of the marginal log-likelihood *is* the expectation-gradient step: the E-step's posteriors weight the
networks' gradients. A gradient step sees a minibatch of whole trajectories.

Everything random in an epoch is seeded by (seed, restart, stage, epoch), so a restart that was interrupted and resumed
from the end of any epoch, in this process or another, gives the same result, bit for bit, as without interruption.
Checkpoints are of ends of epochs.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ddco_pyro.data.reading import Readers
from ddco_pyro.events import EpochEnded, OnEvent, ignore
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.seeding import seeded
from ddco_pyro.training.ascent import Ascent, learning_rate
from ddco_pyro.training.checkpoint import Restart, copy_of
from ddco_pyro.training.convergence import StageEnd, share
from ddco_pyro.training.devices import device_of, repeatable
from ddco_pyro.training.material import Material
from ddco_pyro.training.objective import Diverged, Objective
from ddco_pyro.training.ranks import ALONE, Ranks
from ddco_pyro.training.shards import cut
from ddco_pyro.training.stages import Stage, plan
from ddco_pyro.training.upper import Constants

SAVE_EVERY = 1.0  # s between checkpoints, at least: an epoch of a small model takes less time than its checkpoint


def advance(
    material: Material,
    restart: Restart,
    until: int | None,
    seconds: float = math.inf,
    checkpoint: Path | None = None,
    on_event: OnEvent = ignore,
    ranks: Ranks = ALONE,
) -> tuple[Restart, bool]:
    """Train a restart further, on one thread; the restart, and whether it came as far as it was to.

    :param until: so many epochs of the last stage; None for all that patience and budget allow.
    :param seconds: about how long it may take; an epoch of each stage that it comes to is made in any case.
    :param checkpoint: where it is kept at the end of epochs.
    :param ranks: the processes that do this together, all of them without a limit of time.
    """
    deadline = time.monotonic() + seconds
    device = device_of(material.spec.training)
    with one_thread(), repeatable(device), Readers(material.spec.training.workers) as readers:
        training = Training(material.read_by(readers).held(device), restart, checkpoint, on_event, ranks)
        return restart, training.run(until, deadline)


class Training:
    """A restart in training."""

    def __init__(
        self, material: Material, restart: Restart, checkpoint: Path | None, on_event: OnEvent, ranks: Ranks
    ) -> None:
        self.spec, self.progress = material.spec, restart.progress
        self._material, self._restart, self._checkpoint, self._on_event = material, restart, checkpoint, on_event
        self._ranks = ranks
        self._saved_at = -np.inf  # the first epoch is saved

    def run(self, until: int | None, deadline: float) -> bool:
        """Whether it came as far as it was to, or has diverged, before the deadline."""
        try:
            return self._run(until, deadline)
        except Diverged as error:
            now = self.progress
            now.done, now.diverged, now.best, self._restart.states = True, str(error), -math.inf, {}
            return True

    def _run(self, until: int | None, deadline: float) -> bool:
        now, model = self.progress, self._material.hierarchy(self.progress.restart)
        if "model" in self._restart.states:
            model.load_state_dict(self._restart.states["model"])
        stages = plan(self.spec, model.depth)
        while not now.done:
            last = now.stage == len(stages) - 1
            if not self._run_stage(
                model, stages[now.stage], len(stages) - now.stage, until if last else None, deadline
            ):
                return until is not None and last and now.epoch >= until
            if last:
                now.done, self._restart.states = True, {"best": self._restart.states["best"]}
            else:
                now.stage, now.epoch = now.stage + 1, 0
        return True

    def _run_stage(self, model: Hierarchy, stage: Stage, stages_left: int, until: int | None, deadline: float) -> bool:
        """Whether it has ended, rather than come to the epoch ``until`` or the deadline."""
        now, training, states = self.progress, self.spec.training, self._restart.states
        cap = share(training.epochs, sum(end["epochs"] for end in now.ended), stages_left)
        objective = Objective(self._material, now, stage, self._ranks)
        ascent = Ascent(model, stage, training, objective)
        if now.epoch > 0:
            ascent.restore(states)
            objective.constants = Constants.of(states.get("constants", {}))
        else:
            objective.find_constants(model)
            states["constants"] = objective.constants.state() if objective.constants else {}
            now.start, now.stale = objective.tune(model), 0
            now.best = now.start
            states["best"] = copy_of(model)
        first = now.epoch
        while (cap is None or now.epoch < cap) and (training.patience is None or now.stale < training.patience):
            over = now.epoch > first and time.monotonic() > deadline
            if over or (until is not None and now.epoch >= until):
                states |= ascent.states()
                return False
            ascent.set_rate(learning_rate(training.optimizer, now.epoch, cap))
            train, kept = self._epoch(ascent), ascent.average.model
            self._record(stage, train, objective.tune(kept), kept)
            self._save(ascent)
        model.load_state_dict(states["best"])
        now.ended.append(asdict(StageEnd.of(stage.name, cap, now.tune, training.patience)))
        return True

    def _epoch(self, ascent: Ascent) -> float:
        """One pass over the training demonstrations; the log-likelihood per step seen on the way."""
        now, model, total = self.progress, ascent.model, 0.0
        place = now.restart, now.stage, now.epoch
        with seeded(self._material.seed(*place), model.device):
            model.train()
            minibatches = torch.randperm(len(self._material.train)).split(self.spec.training.batch_size)
            seeds = (partial(self._material.seed, *place, number) for number in range(len(minibatches)))
            shards = [cut(rows, self.spec.training.shards, seed) for rows, seed in zip(minibatches, seeds, strict=True)]
            ascent.objective.read_ahead(model, [shard.rows for each in shards for shard in self._ranks.own(each)])
            for rows, each in zip(minibatches, shards, strict=True):
                total += ascent.step(each, int(self._material.train.lengths[rows].sum()))
            model.eval()
        return total / self._material.train.steps

    def _record(self, stage: Stage, train: float, tune: float, model: Hierarchy) -> None:
        now = self.progress
        now.epoch += 1
        if tune > now.best:
            now.best, now.stale = tune, 0
            self._restart.states["best"] = copy_of(model)
        else:
            now.stale += 1
        row = EpochEnded(now.restart, stage.name, now.epoch, train, tune)
        now.history.append(asdict(row))
        self._on_event(row)

    def _save(self, ascent: Ascent) -> None:
        """Keep it as a checkpoint, unless that was done just before."""
        if self._checkpoint is not None and time.monotonic() - self._saved_at > SAVE_EVERY:
            self._saved_at = time.monotonic()
            self._restart.states |= ascent.states()
            self._restart.write(self._checkpoint)
