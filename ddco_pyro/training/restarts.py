"""Restarts: independent initialisations of a model, of which the best on the tuning demonstrations is kept.

Successive halving: all restarts train until ``training.halving`` epochs of the last stage, the better half until twice
as many, and so on; the last restart alone trains until patience or budget end it. Earlier stages are trained whole,
since their objectives cannot be compared. A restart whose log-likelihood becomes NaN or infinite ends there and ranks
last. The histories alone decide which restarts go on, so that neither the number of processes nor an interruption
changes the result.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.events import (
    OnEvent,
    RestartDiverged,
    RestartStopped,
    TrainingBegan,
    TrainingEnded,
    ignore,
)
from ddco_pyro.inference.engines import STEPS, TRAJECTORIES, EngineCheck, compare_engines
from ddco_pyro.inference.paths import segment
from ddco_pyro.jobs import Workers, processes, run_all
from ddco_pyro.model.batch import encode, refuse_unusable
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.seeding import seeded
from ddco_pyro.spec import Spec, with_overrides
from ddco_pyro.training.checkpoint import Progress, Restart, TrainingData
from ddco_pyro.training.data import tuning_split
from ddco_pyro.training.devices import described, device_of, one_thread
from ddco_pyro.training.labels import Labels
from ddco_pyro.training.loop import train
from ddco_pyro.training.networks import Dimensions, build_hierarchy, model_name
from ddco_pyro.training.objective import TrainingError
from ddco_pyro.training.optimizers import optimizer_of
from ddco_pyro.training.processes import Ranks
from ddco_pyro.training.recognition import Recognition, recognise
from ddco_pyro.training.ridge import cross_validated
from ddco_pyro.training.stages import StageEnd, plan

SHORT = 10.0
"""Seconds of training here before other processes start, which takes seconds itself."""


class OtherDevice(BadInput):
    """A restart was begun on another kind of device than it is to be continued on."""


def train_model(
    spec: Spec,
    dimensions: Dimensions,
    demos: Demonstrations,
    on_event: OnEvent = ignore,
    checkpoints: Path | None = None,
    held_out: Demonstrations | None = None,
    name: str | None = None,
    jobs: int = 1,
) -> Trainer:
    """Train a spec's model on demonstrations, of which ``training.tune_fraction`` are used to tune.

    :param held_out: demonstrations to be evaluated; networks have to be able to read them.
    :param name: of the model in events.
    :param checkpoints: as of :class:`Trainer`, and so are the others.
    :raises DemonstrationsError: a number is too large for networks.
    :raises TrainingError: a log-likelihood is not finite, or the engines disagree.
    """
    with one_thread():
        split = tuning_split(spec, dimensions, demos)
        trainer = Trainer(spec, dimensions, *split, checkpoints, on_event, jobs)
        if held_out is not None:
            refuse_unusable(held_out, trainer.hierarchy.encoder, trainer.hierarchy.scaling)
        trainer.check_engines()
        on_event(training_began(spec, name))
        trainer.run()
    on_event(TrainingEnded(name or model_name(spec)))
    return trainer


def training_began(spec: Spec, name: str | None = None) -> TrainingBegan:
    """The event with which the training of a model begins."""
    epochs, restarts = spec.training.epochs, spec.training.restarts
    return TrainingBegan(name or model_name(spec), None if epochs is None else epochs * restarts)


class Trainer:
    """Trains restarts of a spec's hierarchy on ``train``, stopping and choosing among them by ``tune``.

    :ivar hierarchy: the model: before :meth:`run` without training, then the best restart's.
    :ivar check: how far the engines are apart, once :meth:`check_engines` has compared them.
    :ivar stopped: the restarts that were stopped early, with their epochs of the last stage.
    :ivar agreement: the NMI of the other restarts' segments with the best restart's, once :meth:`run` has compared
        them: of the training demonstrations, at the lowest level.

    :param checkpoints: the folder for a checkpoint of each restart; None for nowhere.
    :param jobs: processes that train restarts side by side, each a whole one; -1 is one for each core. The result is
        the same for any number. Under ``torchrun`` its processes train each restart together (:func:`follow`).
    :raises DemonstrationsError: a number is too large for networks.
    :raises SpecError: the demonstrations lack the labels that the spec names, or have more labels than options.
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
    ) -> None:
        self.spec, self.checkpoints, self.on_event, self.ranks = spec, checkpoints, on_event, Ranks.here()
        self.jobs = Workers(jobs).number(spec.training.restarts)
        self.hierarchy = build_hierarchy(spec, dimensions)
        encoder, scaling = self.hierarchy.encoder, self.hierarchy.scaling
        encoder.fit(train)
        scaling.fit(train)
        encoded = encode(train, encoder, scaling), encode(tune, encoder, scaling)
        fitted = encoder.state_dict(), scaling.state_dict()
        self.data = TrainingData(spec, dimensions, *encoded, train.names, *fitted, Labels.of(spec, train, tune))
        self.ridge = ridge = spec.training.optimizer.ridge.policy
        by_em = optimizer_of(spec.training.optimizer, self.hierarchy) == "em"
        if by_em and spec.training.optimizer.ridge.cross_validated:
            self.ridge = cross_validated(self.hierarchy, encoded[0], ridge, self.data.seed(0))
            raised = with_overrides(spec, {"training.optimizer.ridge.policy": self.ridge})
            self.data = replace(self.data, spec=raised)
        self.recognition: Recognition | None = None
        if self.hierarchy.recogniser is not None:
            every = train if tune is train else replace(train, demonstrations=(*train, *tune), masks={})
            self.data, self.recognition = recognise(self.hierarchy, self.data, every)
        self.restarts: list[Restart] = []
        self.stopped: dict[int, int] = {}
        self.agreement: dict[int, float] = {}
        self.check = EngineCheck(math.nan, math.nan)

    def check_engines(self) -> None:
        """Compare the engines before any training, on a few of the training demonstrations.

        :raises TrainingError: they disagree, or a network gives values that are not finite.
        """
        batch = self.data.train
        few = batch.select(torch.arange(min(len(batch), TRAJECTORIES)), STEPS)
        with seeded(self.spec.seed), torch.no_grad():
            outputs = self.hierarchy(few.inputs)
        if not all(bool(torch.isfinite(values).all()) for values in outputs.tensors()):
            raise TrainingError(
                "before any training a network gives values that are NaN or infinite; look at its code, or at the "
                "ranges of the observations (ddco-pyro inspect)"
            )
        self.check = check = compare_engines(outputs, few.actions, few.lengths)
        if not check.agrees:
            raise TrainingError(
                f"the engines disagree (value {check.value:.1e}, gradient {check.gradient:.1e}): "
                "this is a defect; use inference.engine=enumerate and report it"
            )

    def run(self) -> Hierarchy:
        """Train, and return the best restart's hierarchy in evaluation mode.

        Where all restarts that were left have diverged, the best of the stopped ones is trained to the end instead.

        :raises OtherDevice: a restart was begun on another kind of device than it is to be continued on.
        :raises TrainingError: every restart has diverged.
        """
        self.restarts = [self._begun(number) for number in range(self.spec.training.restarts)]
        self.ranks.share(self.data)
        with processes(self.jobs):
            self._run_rungs()
        self.ranks.share(None)
        if (why := self.restarts[self.best].progress.diverged) is not None:
            raise TrainingError(why)
        if len(self.restarts) > 1 and self.hierarchy.depth:
            from sklearn.metrics import normalized_mutual_info_score

            found = {n: self._segments(n) for n, restart in enumerate(self.restarts) if "best" in restart.states}
            own = found.pop(self.best)
            self.agreement = {n: float(normalized_mutual_info_score(own, other)) for n, other in found.items()}
        self.hierarchy.load_state_dict(self.restarts[self.best].states["best"])
        return self.hierarchy.place(device_of(self.spec.training)).eval()

    def _run_rungs(self) -> None:
        """Train and stop restarts by successive halving, then train the last one, or ones, to the end."""
        left, epochs = list(range(len(self.restarts))), self.spec.training.halving
        worse: list[int] = []  # the best first
        while epochs is not None and len(left) > 1:
            before = len(self.history)
            self._train(left, epochs)
            tops = {n: best_until(self.restarts[n].progress, epochs, self._last(n)) for n in left}
            order = ranked(tops)
            better, behind = sorted(order[: (len(order) + 1) // 2]), order[(len(order) + 1) // 2 :]
            self._stop(sorted(behind), tell=len(self.history) > before)
            left, worse, epochs = better, behind + worse, 2 * epochs
        self._train(left, None)
        while self.restarts[self.best].progress.diverged is not None and self.stopped:
            again = next(number for number in worse if number in self.stopped)
            del self.stopped[again]
            self._train([again], None)

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
        """``training`` of ``metrics.json``: the budget, the best restart's stages, and the epochs of all restarts."""
        optimizer = optimizer_of(self.spec.training.optimizer, self.hierarchy)
        whole = optimizer in ("em", "lbfgs")
        best, updates = self.best, 1 if whole else math.ceil(len(self.data.train) / self.spec.training.batch_size)
        ends = [StageEnd(**end) for end in self.restarts[best].progress.ended]
        each = [
            {
                "epochs": len(restart.progress.history),
                "stopped": self.stopped.get(number),
                "diverged": restart.progress.diverged is not None,
                "initialize": self.spec.training.start(number) if self.hierarchy.depth else None,
                "nmi": self.agreement.get(number),
            }
            for number, restart in enumerate(self.restarts)
        ]

        def effort(epochs: int | None) -> dict[str, int | None]:
            return {"epochs": epochs, "gradient_steps": None if epochs is None else epochs * updates}

        return {
            "budget": effort(self.spec.training.epochs),
            "spent": effort(sum(end.epochs for end in ends)),
            "stages": [asdict(end) | {"converged": end.converged} for end in ends],
            "converged": ends[-1].converged,  # the last stage trains what acts in the end
            "restarts": {"best": best, "spent": effort(len(self.history)), "each": each},
            "device": self.restarts[best].progress.device,
            "by_em": optimizer == "em",
            "by_lbfgs": optimizer == "lbfgs",
            "raised_ridge": self.ridge if self.ridge != self.spec.training.optimizer.ridge.policy else None,
            "recogniser": None if self.recognition is None else self.recognition.as_data(),
        }

    def _segments(self, number: int) -> np.ndarray:
        """A restart's option of the lowest level at each step of the training demonstrations."""
        model = self.data.hierarchy(number, self.restarts[number].states["best"])
        with torch.no_grad():
            pieces = (piece for _, piece in self.data.train.pieces(model.steps_at_once))
            found = [segment(model.recognised(model.tabulate(piece), piece), piece.lengths)[0] for piece in pieces]
        return torch.cat([choices[choices >= 0] for choices in found]).numpy()

    def _last(self, number: int) -> int:
        """The last stage of a restart."""
        return len(plan(self.spec, self.hierarchy.depth, number)) - 1

    @property
    def _whole(self) -> list[Restart]:
        return [restart for restart in self.restarts if restart.progress.restart not in self.stopped]

    def _begun(self, number: int) -> Restart:
        """A restart from its checkpoint, or at its beginning.

        :raises Damaged: it does not hold what was written.
        """
        path = self._path(number)
        if path is None or not path.exists():
            return Restart(Progress(number, device=described(device_of(self.spec.training))))
        return Restart.read(path)

    def _refuse_other_device(self, progress: Progress, until: int | None) -> None:
        """A restart may be trained further on the kind of device alone that it was begun on.

        :raises OtherDevice: it was begun on another kind of device.
        """
        device = described(device_of(self.spec.training))
        if progress.device != device and not progress.reached(self._last(progress.restart), until):
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
        """Train restarts until so many epochs of the last stage, None for to the end; jobs share what takes long.

        :raises OtherDevice: a restart was begun on another kind of device; nothing is trained then.
        """
        left = [number for number in numbers if not self.restarts[number].progress.done]
        for number in left:
            self._refuse_other_device(self.restarts[number].progress, until)
        deadline = time.monotonic() + (math.inf if self.jobs == 1 else SHORT)
        while left and (len(left) == 1 or time.monotonic() < deadline):
            own, seconds = self.restarts[left[0]], math.inf if len(left) == 1 else deadline - time.monotonic()
            self.ranks.share((own, until))
            self._keep(train(self.data, own, until, seconds, self._path(left[0]), self.on_event))
            if seconds == math.inf or time.monotonic() < deadline:  # or it has paused
                del left[0]
        if not left:
            return
        calls = {n: partial(train, self.data, self.restarts[n], until, math.inf, self._path(n)) for n in left}
        with run_all(calls, Workers(self.jobs), "trained a restart", self.on_event) as trained:
            for _, restart in trained:
                self._keep(restart)

    def _keep(self, restart: Restart) -> None:
        number, why = restart.progress.restart, restart.progress.diverged
        self.restarts[number] = restart
        if why is not None and len(self.restarts) > 1:
            self.on_event(RestartDiverged(number, why))


def follow(ranks: Ranks) -> None:
    """Train along with the first process: every restart of every model that its :class:`Trainer` trains."""
    while (data := ranks.share()) is not None:
        while (work := ranks.share()) is not None:
            restart, until = work
            train(data, restart, until)


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
