"""Restarts: a model is trained from several starts, and the likeliest in training is kept.

EM and gradient ascent end near where they began. ``training.starts`` lists ways to begin; each is a restart.
All restarts train for :data:`SOUNDING` epochs of their last stage. Those that are far behind by then are
stopped, and the others train until patience or budget end them. The objective that decides is of the training
demonstrations: the log-likelihood (``control.power``) with the log-prior of the ridges. A restart whose
log-likelihood becomes NaN or infinite ends there and ranks last. Neither the number of processes nor an
interruption changes the result.

A hierarchy contains its memoryless mixture (ψ = 1), and EM ends with one that is no less likely in training
(:meth:`Trainer.contain`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.events import OnEvent, RestartDiverged, RestartStopped, TrainingBegan, TrainingEnded, ignore
from ddco_pyro.inference.engines import STEPS, TRAJECTORIES, EngineCheck, compare_engines, log_likelihood
from ddco_pyro.inference.paths import segment
from ddco_pyro.jobs import Workers, run_all
from ddco_pyro.metrics import Recogniser
from ddco_pyro.model.batch import Batch, encode, refuse_unusable
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.seeding import seeded
from ddco_pyro.model.tables import Tables
from ddco_pyro.spec import Spec, with_overrides
from ddco_pyro.training.checkpoint import Progress, Restart, TrainingData, copy_of, fitted_of
from ddco_pyro.training.data import tuning_split
from ddco_pyro.training.em import Expectation
from ddco_pyro.training.initialization import cross_validated
from ddco_pyro.training.labels import Labels
from ddco_pyro.training.loop import train
from ddco_pyro.training.networks import Dimensions, build_hierarchy, model_name
from ddco_pyro.training.objective import TrainingError
from ddco_pyro.training.optimizers import optimizer_of
from ddco_pyro.training.prior import Prior
from ddco_pyro.training.processes import Ranks, described, device_of, one_thread
from ddco_pyro.training.recognition import recognise
from ddco_pyro.training.stages import EVERYTHING, plan, starts_of

SOUNDING, BY_GRADIENT = 5, 50
"""Epochs of the last stage before restarts are compared: of EM, and of gradient steps."""
LIKELY = 50
"""Epochs in which EM of a restart is likely to converge."""
BEHIND = 0.1
"""Nats per step and control dimension by which a restart that is stopped is behind the likeliest."""
BESIDE = "the mixture beside"
"""What a restart that goes on from a baseline begins from."""
ROUNDING = 1e-3
"""Nats per step by which objectives of models that say the same may differ."""
SELDOM = -4.0
"""A logit of ψ with which options last: 55 steps in the mean."""
ALMOST_ALWAYS = 6.0
"""A logit of ψ with which options that last are as likely as the mixture, up to 0.004 nats per step."""


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
    library: Prior | None = None,
) -> Trainer:
    """Train a spec's model on demonstrations, of which ``training.tune_fraction`` are used to tune.

    :param held_out: demonstrations to be evaluated; networks have to be able to read them.
    :param name: of the model in events.
    :param checkpoints: as of :class:`Trainer`, and so are ``jobs`` and ``library``.
    :raises DemonstrationsError: a number is too large for networks.
    :raises TrainingError: a log-likelihood is not finite, or the engines disagree.
    """
    with one_thread():
        split = tuning_split(spec, dimensions, demos)
        trainer = Trainer(spec, dimensions, *split, checkpoints, on_event, jobs, library)
        if held_out is not None:
            refuse_unusable(held_out, trainer.hierarchy.encoder, trainer.hierarchy.scaling)
        trainer.check_engines()
        on_event(training_began(spec, name))
        trainer.run()
    on_event(TrainingEnded(name or model_name(spec)))
    return trainer


def training_began(spec: Spec, name: str | None = None) -> TrainingBegan:
    """The event with which the training of a model begins, with the epochs that are likely to come."""
    epochs = spec.training.epochs
    if epochs is not None and spec.hierarchy is not None and spec.training.optimizer.name == "em":
        epochs = min(epochs, LIKELY)
    return TrainingBegan(name or model_name(spec), None if epochs is None else epochs * len(starts_of(spec)))


class Trainer:
    """Trains restarts of a spec's hierarchy on ``train``, of which the likeliest there is kept.

    Demonstrations to ``tune`` with end each restart.

    :ivar hierarchy: the model: before :meth:`run` without training, then the best restart's.
    :ivar check: how far the engines are apart, once :meth:`check_engines` has compared them.
    :ivar stopped: the restarts that were stopped early, with their epochs of the last stage.
    :ivar agreement: the NMI of the other restarts' segments with the best restart's, once :meth:`run` has
        compared them: of the training demonstrations, at the lowest level.

    :param checkpoints: the folder for a checkpoint of each restart; None for nowhere.
    :param jobs: processes that train restarts side by side, each a whole one; -1 is one for each core. The
        result is the same for any number. Under ``torchrun`` its processes train each restart together
        (:func:`follow`).
    :param library: the prior that the spec's ``training.library`` is.
    :raises DemonstrationsError: a number is too large for networks.
    :raises SpecError: the demonstrations lack the labels that the spec names, or have more than options.
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
        library: Prior | None = None,
    ) -> None:
        self.spec, self.checkpoints, self.on_event, self.ranks = spec, checkpoints, on_event, Ranks.here()
        self.jobs = Workers(jobs).number(len(starts_of(spec)))
        self.hierarchy = build_hierarchy(spec, dimensions)
        encoder, scaling = self.hierarchy.encoder, self.hierarchy.scaling
        if library is None:
            encoder.fit(train)
            scaling.fit(train)
        else:
            encoder.load_state_dict(library.model.encoder.state_dict())
            scaling.load_state_dict(library.model.scaling.state_dict())
        known = library is not None
        encoded = encode(train, encoder, scaling, known), encode(tune, encoder, scaling, known)
        labels, fitted = Labels.of(spec, train, tune), fitted_of(self.hierarchy)
        self.data = TrainingData(spec, dimensions, *encoded, train.names, fitted, labels, library)
        self.ridge = ridge = spec.training.optimizer.ridge.policy
        if library is not None and library.ridge:
            self.ridge = library.ridge
        elif self._optimizer == "em" and spec.training.optimizer.ridge.cross_validated:
            self.ridge = cross_validated(self.hierarchy, encoded[0], ridge, self.data.seed(0))
            raised = with_overrides(spec, {"training.optimizer.ridge.policy": self.ridge})
            self.data = replace(self.data, spec=raised)
        self.recognition: Recogniser | None = None
        if self.hierarchy.recogniser is not None:
            every = train if tune is train else replace(train, demonstrations=(*train, *tune), masks={})
            self.data, self.recognition = recognise(self.hierarchy, self.data, every)
        self.restarts: list[Restart] = []
        self.stopped: dict[int, int] = {}
        self._least = -math.inf
        self.agreement: dict[int, float] = {}
        self.check = EngineCheck(math.nan, math.nan)

    def check_engines(self) -> None:
        """Compare the engines before any training, on a few of the training demonstrations.

        EM's log-prior of a library is compared with the Pyro program's, at random weights and the library's.

        :raises TrainingError: they disagree, or a network gives values that are not finite.
        """
        batch = self.data.train
        few = batch.select(torch.arange(min(len(batch), TRAJECTORIES)), STEPS)
        with seeded(self.spec.seed), torch.no_grad():
            outputs = self.hierarchy(few.inputs)
        if not all(bool(torch.isfinite(values).all()) for values in outputs.tensors()):
            raise TrainingError(
                "before any training a network gives values that are NaN or infinite; look at its code, or "
                "at the ranges of the observations (ddco-pyro inspect)"
            )
        check = compare_engines(outputs, few.actions, few.lengths)
        if self.data.library is not None and self.data.library.ridge and self._optimizer == "em":
            gap = self._prior_gap(self.data.library, few)
            check = check._replace(value=max(check.value, gap))
        self.check = check
        if not check.agrees:
            raise TrainingError(
                f"the engines disagree (value {check.value:.1e}, gradient {check.gradient:.1e}): "
                "this is a defect; use inference=enumerate and report it"
            )

    def _prior_gap(self, library: Prior, batch: Batch) -> float:
        """The relative difference between EM's log-prior and the program's; each has constants of its own."""

        def score(tables: Tables, piece: Batch, rows: torch.Tensor) -> torch.Tensor:
            return log_likelihood(tables, piece.lengths).sum()

        of_library = {**self.hierarchy.state_dict(), **copy_of(library.model)}
        models = (self.hierarchy, self.data.hierarchy(0, of_library))
        ridge = self.spec.training.optimizer.ridge
        by_em = [Expectation(one, EVERYTHING, score, ridge, prior=library).log_prior(batch) for one in models]
        with torch.no_grad():
            by_program = [float(library.log_density(one)) for one in models]
        scale = max(1.0, abs(by_program[1] - by_program[0]))
        return abs(by_em[1] - by_em[0] - by_program[1] + by_program[0]) / scale

    def run(self) -> Hierarchy:
        """Train, and return the best restart's hierarchy in evaluation mode.

        Where all restarts that were left have diverged, the stopped ones are trained to the end instead.

        :raises OtherDevice: a restart was begun on another kind of device.
        :raises TrainingError: every restart has diverged.
        """
        self.restarts = [self._begun(number) for number in range(len(starts_of(self.spec)))]
        every = range(len(self.restarts))
        with self._together():
            if len(every) > 1:
                self._train(every, BY_GRADIENT if self._by_gradient else SOUNDING)
                self._stop_behind()
            self._train([number for number in every if number not in self.stopped])
            if self.restarts[self.best].progress.diverged is not None and self.stopped:
                again, self.stopped = [*self.stopped], {}
                self._train(again)
        if (why := self.restarts[self.best].progress.diverged) is not None:
            raise TrainingError(why)
        return self._keep_best()

    def contain(self, mixture: Hierarchy, objective: float) -> Hierarchy:
        """Keep no model that is less likely in training than a mixture which the hierarchy contains.

        Where no restart is as likely, EM goes on from the mixture: first with options that last, then with ψ
        nearly 1, where they are as likely as the mixture from the first step on. Gradient steps do not go on,
        since they would take more than the mixture's budget.

        :param mixture: networks of the same spec, whose options end after every step.
        :param objective: of the mixture, nats per step of the same demonstrations.
        :returns: the best restart's hierarchy.
        """
        self._least = max(self._least, objective - ROUNDING)
        for logit in () if self._by_gradient else (SELDOM, ALMOST_ALWAYS):
            if self.objective >= self._least:
                break
            self._go_on(mixture, logit)
        return self._keep_best()

    def _go_on(self, mixture: Hierarchy, logit: float) -> None:
        """Train one more restart, which begins as a mixture with every ψ at a logit."""
        number = len(self.restarts)
        starts = [*starts_of(self.data.spec), "mixture"]
        self.data = replace(self.data, spec=with_overrides(self.data.spec, {"training.starts": starts}))
        model = self.data.hierarchy(number)
        model.begin_terminations(logit)
        begun = Progress(number, stage=self._last(number), device=described(device_of(self.spec.training)))
        beginning = Restart(begun, {"model": copy_of(model) | copy_of(mixture)})
        self.restarts.append(self._begun(number, beginning))
        with self._together():
            self._train([number])

    def _keep_best(self) -> Hierarchy:
        if len(self.restarts) > 1 and self.hierarchy.depth:
            from sklearn.metrics import normalized_mutual_info_score as nmi

            ended = [n for n, restart in enumerate(self.restarts) if "best" in restart.states]
            found = {n: self._segments(n) for n in ended}
            own = found.pop(self.best)
            self.agreement = {n: float(nmi(own, other)) for n, other in found.items()}
        self.hierarchy.load_state_dict(self.restarts[self.best].states["best"])
        return self.hierarchy.place(device_of(self.spec.training)).eval()

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Inside, the processes of ``torchrun`` train along (:func:`follow`)."""
        self.ranks.share(self.data)
        yield
        self.ranks.share(None)

    @property
    def _optimizer(self) -> str:
        return optimizer_of(self.spec.training.optimizer, self.hierarchy)

    @property
    def _by_gradient(self) -> bool:
        return self._optimizer not in ("em", "lbfgs")

    def _stop_behind(self) -> None:
        """Stop the restarts that are far behind the likeliest, unless they have finished."""
        each = [restart.progress for restart in self.restarts]
        least = max(now.sounded for now in each) - BEHIND * self.hierarchy.scaling.size
        for now in each:
            if now.sounded < least and not now.done:
                self.stopped[now.restart] = now.epoch
                self.on_event(RestartStopped(now.restart, now.epoch))

    @property
    def objective(self) -> float:
        """The objective of the best restart, nats per step of the training demonstrations."""
        return self.restarts[self.best].progress.objective

    @property
    def best(self) -> int:
        """The likeliest restart in training; the first where no other is likelier by ``training.margin``.

        One that is less likely than the mixture is not kept by the margin.
        """
        values = {n: one.progress.objective for n, one in enumerate(self.restarts) if n not in self.stopped}
        best = max(values, key=lambda number: (values[number], -number))
        least = max(self._least, values[best] - self.spec.training.margin)
        return 0 if 0 in values and values[0] >= least else best

    @property
    def history(self) -> list[dict[str, Any]]:
        """A row for each epoch, restart after restart."""
        return [row for restart in self.restarts for row in restart.progress.history]

    @property
    def summary(self) -> dict[str, Any]:
        """``training`` of ``metrics.json``: budget, the best restart's stages, epochs of all restarts."""
        optimizer, best, kept = self._optimizer, self.best, self.restarts[self.best].progress
        updates = math.ceil(len(self.data.train) / self.spec.training.batch_size) if self._by_gradient else 1
        starts = [*starts_of(self.spec), BESIDE, BESIDE]
        each = [
            {
                "epochs": len(now.history),
                "stopped": self.stopped.get(number),
                "diverged": now.diverged is not None,
                "start": starts[number],
                "objective": None if math.isinf(now.objective) else now.objective,
                "nmi": self.agreement.get(number),
            }
            for number, now in enumerate(restart.progress for restart in self.restarts)
        ]

        def effort(epochs: int | None) -> dict[str, int | None]:
            return {"epochs": epochs, "gradient_steps": None if epochs is None else epochs * updates}

        return {
            "budget": effort(self.spec.training.epochs),
            "spent": effort(kept.spent),
            "stages": kept.ended,
            "converged": kept.ended[-1]["converged"],  # the last stage trains what acts in the end
            "restarts": {"best": best, "spent": effort(len(self.history)), "each": each},
            "device": kept.device,
            "objective": self.objective,
            "by_em": optimizer == "em",
            "by_lbfgs": optimizer == "lbfgs",
            "raised_ridge": self.ridge if self.ridge != self.spec.training.optimizer.ridge.policy else None,
            "recogniser": None if self.recognition is None else self.recognition.model_dump(),
        }

    def _segments(self, number: int) -> np.ndarray:
        """A restart's option of the lowest level at each step of the training demonstrations."""
        model = self.data.hierarchy(number, self.restarts[number].states["best"])
        with torch.no_grad():
            pieces = (piece for _, piece in self.data.train.pieces(model.steps_at_once))
            tables = ((model.recognised(model.tabulate(piece), piece), piece.lengths) for piece in pieces)
            found = [segment(*own)[0] for own in tables]
        return torch.cat([choices[choices >= 0] for choices in found]).numpy()

    def _last(self, number: int) -> int:
        """The last stage of a restart."""
        return len(plan(self.data.spec, self.hierarchy.depth, number)) - 1

    def _begun(self, number: int, beginning: Restart | None = None) -> Restart:
        """A restart from its checkpoint, or at its beginning: None for that of its way to begin.

        :raises Damaged: it does not hold what was written.
        :raises OtherDevice: it was begun on another kind of device than it is to be continued on.
        """
        path, device = self._path(number), described(device_of(self.spec.training))
        if path is None or not path.exists():
            return beginning or Restart(Progress(number, device=device))
        begun = Restart.read(path)
        if begun.progress.device != device and not begun.progress.done:
            raise OtherDevice(
                f"{path}: was trained on {begun.progress.device}, and networks are on {device} here, where "
                "the last digits differ; continue it there, or remove it: this restart then begins anew"
            )
        return begun

    def _path(self, number: int) -> Path | None:
        return None if self.checkpoints is None else self.checkpoints / f"restart-{number}.safetensors"

    def _train(self, numbers: Sequence[int], until: int | None = None) -> None:
        """Train restarts until so many epochs of the last stage, or to the end; jobs share gradient steps."""
        left = [n for n in numbers if not self.restarts[n].progress.reached(self._last(n), until)]
        if len(left) > 1 and self.jobs > 1 and self._by_gradient:
            calls = {n: partial(train, self.data, self.restarts[n], until, self._path(n)) for n in left}
            with run_all(calls, Workers(self.jobs), "trained a restart", self.on_event) as trained:
                for _, restart in trained:
                    self._keep(restart)
            return
        for number in left:
            self.ranks.share((self.restarts[number], until))
            self._keep(train(self.data, self.restarts[number], until, self._path(number), self.on_event))

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
