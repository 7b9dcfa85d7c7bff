"""Restarts: independent initialisations, trained side by side, of which the worse half is stopped again and again.

Successive halving on tuning likelihood: all train until ``training.halving`` epochs of the last stage, the better half
until twice as many, and so on; the last alone trains until patience or budget end it. Earlier stages are trained whole,
since what they maximise cannot be compared. A restart whose log-likelihood becomes NaN or infinite ends there and is
the worst of all. Who goes on follows from the histories alone, so that neither the number of processes nor an
interruption changes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.events import EpochEnded, OnEvent, RestartDiverged, RestartStopped, ignore
from ddco_pyro.model.encoding import encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.spec import Spec
from ddco_pyro.training.checkpoint import Progress, Restart
from ddco_pyro.training.convergence import StageEnd, summary
from ddco_pyro.training.devices import described, device_of
from ddco_pyro.training.jobs import pool, results, useful_jobs
from ddco_pyro.training.labels import Labels
from ddco_pyro.training.loop import advance
from ddco_pyro.training.material import Material
from ddco_pyro.training.networks import Dimensions, build_hierarchy
from ddco_pyro.training.objective import TrainingError
from ddco_pyro.training.ranks import ALONE, Ranks
from ddco_pyro.training.stages import plan

SLICE = 10.0
"""Seconds that a process trains a restart before it tells how it went, and is given the next."""

DEAD = (
    "a process that trained a restart was ended from outside (too little memory?); what was trained is kept in a run "
    "folder: continue with the same command, with fewer --jobs if memory was short"
)


class OtherDevice(BadInput):
    """A restart was begun on another kind of device than it is to be continued on."""


class Trainer:
    """Trains a spec's hierarchy on ``train``, stopping and choosing among restarts by ``tune``.

    ``first`` is the hierarchy before any training.

    :param checkpoints: the folder in which each restart is kept at the end of epochs; None for nowhere.
    :param jobs: processes that train restarts; -1 is one for each core. The result is the same for any number.
    :param ranks: processes that train each restart together instead, of which this is the first (:func:`follow`).
    :raises DemonstrationsError: a number is too large for networks.
    :raises SpecError: there are no labels where the spec names some, or more than options.
    """

    def __init__(
        self,
        spec: Spec,
        dimensions: Dimensions,
        train: Demonstrations,
        tune: Demonstrations,
        checkpoints: Path | None = None,
        on_event: OnEvent = ignore,
        jobs: int = 1,
        ranks: Ranks = ALONE,
    ) -> None:
        self.ranks = ranks
        self.spec, self.checkpoints, self.on_event = spec, checkpoints, on_event
        self.jobs = useful_jobs(jobs, spec.training.restarts)
        self.first = build_hierarchy(spec, dimensions)  # its encoder and scaling are those of all restarts
        self.first.encoder.fit(train)
        self.first.scaling.fit(train)
        encoder, scaling = self.first.encoder, self.first.scaling
        varied = replace(encode(train, encoder, scaling), versions=encoder.versions(train))
        encoded = varied, encode(tune, encoder, scaling)
        fitted = encoder.state_dict(), scaling.state_dict()
        labels = Labels.of(spec, train, tune)
        self.material = Material(spec, dimensions, *encoded, train.names, *fitted, labels)
        self.restarts: list[Restart] = []
        self.stopped: dict[int, int] = {}

    def run(self) -> Hierarchy:
        """The best restart's hierarchy, in evaluation mode.

        Where all that were left have diverged, the best of those that were stopped is trained to the end instead.

        :raises OtherDevice: a restart was begun on another kind of device than it is to be continued on.
        :raises TrainingError: every restart has diverged.
        """
        self.restarts = [self._begun(number) for number in range(self.spec.training.restarts)]
        self.ranks.share(self.material)
        left, epochs = list(range(len(self.restarts))), self.spec.training.halving
        worse: list[int] = []  # the best first
        while epochs is not None and len(left) > 1:
            before = len(self.history)
            self._train(left, epochs)
            last = len(plan(self.spec, self.first.depth)) - 1
            order = ranked({number: best_until(self.restarts[number].progress, epochs, last) for number in left})
            better, behind = sorted(order[: (len(order) + 1) // 2]), order[(len(order) + 1) // 2 :]
            self._stop(sorted(behind), tell=len(self.history) > before)
            left, worse, epochs = better, behind + worse, 2 * epochs
        self._train(left, None)
        while self.restarts[self.best].progress.diverged is not None and self.stopped:
            again = next(number for number in worse if number in self.stopped)
            del self.stopped[again]
            self._train([again], None)
        self.ranks.share(None)
        if (why := self.restarts[self.best].progress.diverged) is not None:
            self.ranks.share(None)  # that was all
            raise TrainingError(why)
        model = self.material.hierarchy(self.best)
        model.load_state_dict(self.restarts[self.best].states["best"])
        return model.eval()

    @property
    def best(self) -> int:
        """The restart with the best tuning log-likelihood, the first of equals; one that diverged where all did."""
        whole = [restart.progress for restart in self._whole]
        sound = [progress for progress in whole if progress.diverged is None]
        return ranked({progress.restart: progress.best for progress in sound or whole})[0]

    @property
    def history(self) -> list[dict[str, Any]]:
        """A row for each epoch, restart after restart."""
        return [row for restart in self.restarts for row in restart.progress.history]

    @property
    def summary(self) -> dict[str, Any]:
        """How the best restart was trained, and what all of them took, for ``metrics.json``."""
        ends = [StageEnd(**end) for end in self.restarts[self.best].progress.ended]
        updates = math.ceil(len(self.material.train) / self.spec.training.batch_size)
        spent = [len(restart.progress.history) for restart in self.restarts]
        diverged = [restart.progress.restart for restart in self.restarts if restart.progress.diverged is not None]
        made = summary(self.spec.training, ends, updates, self.best, spent, self.stopped, diverged)
        return made | {"device": self.restarts[self.best].progress.device}

    @property
    def _whole(self) -> list[Restart]:
        return [restart for restart in self.restarts if restart.progress.restart not in self.stopped]

    def _begun(self, number: int) -> Restart:
        """A restart as it was kept, or as it begins.

        :raises Damaged: it does not hold what was written.
        """
        path = self._path(number)
        if path is None or not path.exists():
            return Restart(Progress(number, device=described(device_of(self.spec.training))))
        return Restart.read(path)

    def _refuse_other_device(self, progress: Progress, until: int | None) -> None:
        """What has come as far as it is to is taken from any device; what is trained further is not.

        :raises OtherDevice: it was begun on another kind of device.
        """
        device, last = described(device_of(self.spec.training)), len(plan(self.spec, self.first.depth)) - 1
        arrived = until is not None and progress.stage == last and progress.epoch >= until
        if progress.device != device and not arrived:
            raise OtherDevice(
                f"{self._path(progress.restart)}: was trained on {progress.device}, and networks are on {device} here, "
                "where the last digits differ; continue it there, or remove it: this restart then begins anew"
            )

    def _path(self, number: int) -> Path | None:
        return None if self.checkpoints is None else self.checkpoints / f"restart-{number}.safetensors"

    def _stop(self, numbers: Sequence[int], tell: bool) -> None:
        """Those that are done need not be stopped.

        :param tell: whether it is news: where nothing was trained for it, they were stopped before an interruption.
        """
        for number in numbers:
            progress = self.restarts[number].progress
            if not progress.done:
                self.stopped[number] = progress.epoch
                if tell:
                    self.on_event(RestartStopped(number, progress.epoch))

    def _train(self, numbers: Sequence[int], until: int | None) -> None:
        """Train these restarts until so many epochs of the last stage, None for to the end; processes in slices.

        :raises OtherDevice: one of them was begun on another kind of device; nothing is trained then.
        """
        left = [number for number in numbers if not self.restarts[number].progress.done]
        for number in left:
            self._refuse_other_device(self.restarts[number].progress, until)
        if self.jobs == 1 or len(left) < 2:
            for number in left:
                restart, path = self.restarts[number], self._path(number)
                self.ranks.share((restart, until))
                self._keep(advance(self.material, restart, until, math.inf, path, self.on_event, self.ranks)[0])
            return
        with pool(self.jobs) as parallel:
            while left:
                calls = [partial(advance, self.material, self.restarts[number], until, SLICE) for number in left]
                for restart, arrived in results(parallel, calls, DEAD):
                    before = self.restarts[restart.progress.restart].progress
                    self._keep(restart)
                    for row in restart.progress.history[len(before.history) :]:
                        self.on_event(EpochEnded(**row))
                    if arrived:
                        left.remove(restart.progress.restart)

    def _keep(self, restart: Restart) -> None:
        number, why = restart.progress.restart, restart.progress.diverged
        self.restarts[number] = restart
        path = self._path(number)
        if path is not None:
            restart.write(path)
        if why is not None and len(self.restarts) > 1:
            self.on_event(RestartDiverged(number, why))


def follow(ranks: Ranks) -> None:
    """Train along with the first process: each restart that its :class:`Trainer` trains, of each model, until it says
    that this was all.
    """
    while (material := ranks.share()) is not None:
        while (work := ranks.share()) is not None:
            restart, until = work
            advance(material, restart, until, ranks=ranks)


def best_until(progress: Progress, epochs: int, last: int) -> float:
    """The best tuning log-likelihood per step before and in the first epochs of the last stage, whose number is
    ``last``; -inf where the restart has diverged by then. What comes later does not count: an interrupted training may
    have gone further than one that has just arrived there.
    """
    if progress.diverged is not None and (progress.stage < last or progress.epoch < epochs):
        return -math.inf
    return max(progress.tune[: epochs + 1])


def ranked(values: Mapping[int, float]) -> list[int]:
    """Restarts, the best first; what is not a number is worst, and the first of equals is the better."""
    return sorted(values, key=lambda number: (-values[number] if values[number] > -math.inf else math.inf, number))
