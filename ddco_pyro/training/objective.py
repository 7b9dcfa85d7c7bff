"""The objective of a stage of training."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import chain
from statistics import median

import torch
from torch import Tensor

from ddco_pyro.errors import Failed
from ddco_pyro.inference.engines import log_likelihood
from ddco_pyro.model.batch import Batch
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.outputs import Outputs
from ddco_pyro.model.tables import Tables
from ddco_pyro.training.checkpoint import Progress, State, TrainingData
from ddco_pyro.training.initialization import WAYS, Clusters, equal_parts
from ddco_pyro.training.processes import Ranks
from ddco_pyro.training.stages import Stage, starts_of
from ddco_pyro.training.upper import Constants, expected, fitted


class TrainingError(Failed):
    """Training cannot go on: the message names the trajectory or the checkpoint and says what to do."""


class Diverged(TrainingError):
    """The log-likelihood of training demonstrations is NaN or infinite; its restart has no further epoch."""


Known = dict[int, Tensor]
"""By level (1 is lowest): each step's known choice [N, T], -1 where it is free; or evidence of choices."""


class Objective:
    """The objective of a stage: the log-likelihood given the known choices.

    In a stage with ``from_constants`` the expected log-probability of selections and terminations (an M-step)
    takes the place of the log-likelihood. In a stage with ``selecting`` the levels and the meta-policy are
    trained apart: the objective is the sum of two log-likelihoods, and their mean is what is reported.

    :param states: the checkpoint from which the stage goes on; None at the beginning of the stage.
    :ivar known: the known choices of the training and of the tuning demonstrations.
    :ivar evidence: of the choices of other steps, in nats, [N, T, 1 + k] by level.
    :ivar likelihoods: the number of log-likelihoods whose mean is reported.
    """

    def __init__(
        self,
        data: TrainingData,
        progress: Progress,
        stage: Stage,
        states: Mapping[str, State] | None = None,
    ) -> None:
        self.data, self.progress, self.stage, self.ranks = data, progress, stage, Ranks.here()
        self.likelihoods = 2 if stage.selecting else 1
        self.constants = Constants.of((states or {}).get("constants", {}))
        self.known: tuple[Known, Known] = {}, {}
        self.evidence: tuple[Known, Known] = {}, {}
        labels = data.labels
        if labels is not None and (stage.discovering is None or labels.level <= stage.discovering):
            self.known = {labels.level: labels.train}, {labels.level: labels.tune}
            if labels.evidence is not None:
                self.evidence = {labels.level: labels.evidence[0]}, {labels.level: labels.evidence[1]}
        if stage.clamped is not None:
            if states is None:
                self._clamp_to_start(stage.clamped)
            else:  # clusters are found once
                for known, part in zip(self.known, ("train", "tune"), strict=True):
                    known[stage.clamped] = states["known"][part].long()

    def states(self) -> dict[str, State]:
        """The state of the objective in a checkpoint."""
        clamped = self.stage.clamped
        parts = zip(("train", "tune"), self.known, strict=True)
        known = {} if clamped is None else {part: known[clamped].short() for part, known in parts}
        return {"known": known, "constants": self.constants.state() if self.constants else {}}

    def _clamp_to_start(self, level: int) -> None:
        """A step without a label has its cluster, or its part of the demonstration, as known choice."""
        data, hierarchy = self.data, self.data.spec.hierarchy
        assert hierarchy is not None  # only levels are clamped
        restart = self.progress.restart
        seed = data.seed(restart, self.progress.stage)
        if (labels := data.labels) is not None and labels.level == level and labels.starts is not None:
            for known, found in zip(self.known, labels.starts, strict=True):
                known[level] = torch.where(known[level] < 0, found, known[level])
            return
        count, way = hierarchy.levels[level - 1].count, WAYS[starts_of(data.spec)[restart]]
        if not way.ordered:
            best = not data.repetition(restart)  # further restarts are to differ
            window = data.spec.training.window if way.windowed else 0
            own = self.known[0].get(level), hierarchy.read_by(level)
            clusters = Clusters(data.train, count, seed, way.controls, *own, best, window)
        for known, batch in zip(self.known, (data.train, data.tune), strict=True):
            choices = equal_parts(batch, count) if way.ordered else clusters.choices(batch)
            labelled = known.get(level, choices)
            known[level] = torch.where(labelled < 0, choices, labelled)

    def find_constants(self, model: Hierarchy) -> None:
        """Find the constants that the networks take over, given the lowest level of the model."""
        if self.stage.from_constants:
            with torch.no_grad():
                pieces = self.data.train.pieces(model.steps_at_once)
                tables = [(self.tables(model, piece, rows), piece.lengths) for rows, piece in pieces]
            self.constants = fitted(tables, self.data.seed(self.progress.restart, self.progress.stage))

    def tables(self, model: Hierarchy, batch: Batch, rows: Tensor, tuning: bool = False) -> Tables:
        """The tables of demonstrations as logits, with their known choices.

        :param rows: of the demonstrations among those to train with, or to tune with, [N].
        """
        outputs: Outputs = model(batch.inputs, self.stage.discovering)
        return self.clamped(outputs.logits(batch.actions), rows, tuning)

    def clamped(self, tables: Tables, rows: Tensor, tuning: bool = False) -> Tables:
        """The tables with known choices clamped, evidence of the others, and ψ = 1 in a memoryless stage."""
        if self.stage.memoryless:
            tables = tables.memoryless()
        for level, choices in self.known[tuning].items():
            tables = tables.clamp(level, choices[rows, : tables.steps])
        for level, evidence in self.evidence[tuning].items():
            tables = tables.with_evidence(level, evidence[rows, : tables.steps])
        return tables

    def score(self, tables: Tables, piece: Batch, rows: Tensor) -> Tensor:
        """The objective of a piece of the training demonstrations from its tables, nats.

        :param rows: of the demonstrations, [N].
        """
        return self.values(self.clamped(tables, rows), piece.lengths).sum()

    def values(self, tables: Tables, lengths: Tensor) -> Tensor:
        """The objective of each demonstration, nats, [N] in float64.

        :param lengths: steps of each demonstration, [N].
        """
        if self.constants is not None:
            return expected(tables, lengths, self.constants)
        likelihood = partial(log_likelihood, lengths=lengths, engine=self.data.spec.inference)
        if self.stage.selecting:
            levels, meta_policy = tables.apart()
            return likelihood(levels) + likelihood(meta_policy)
        return likelihood(tables)

    def tune(self, model: Hierarchy) -> float:
        """The objective per step of the tuning demonstrations: the mean, or the median over demonstrations.

        Where those are all that train, the log-prior of a library is part of it.
        """
        tune, training, prior = self.data.tune, self.data.spec.training, 0.0
        with torch.no_grad():
            pieces = tune.pieces(model.steps_at_once)
            each = self.ranks.each(partial(self._tuned, model, *piece) for piece in pieces)
            values = list(chain.from_iterable(each))
            if self.data.library is not None and training.tune_fraction == 0:
                prior = float(self.data.library.log_density(model)) / tune.steps
        if training.tune_by == "median":
            pairs = zip(values, tune.lengths.tolist(), strict=True)
            return prior + median(value / steps for value, steps in pairs)
        return prior + sum(values) / tune.steps

    def _tuned(self, model: Hierarchy, rows: Tensor, batch: Batch) -> list[float]:
        values = self.values(self.tables(model, batch, rows, tuning=True), batch.lengths) / self.likelihoods
        return values.tolist()

    def diverged(self, tables: Tables, lengths: Tensor, rows: Tensor) -> Diverged:
        """The error that names the training demonstrations whose log-likelihood is not finite."""
        with torch.no_grad():
            finite = torch.isfinite(log_likelihood(tables, lengths))
        bad = [self.data.names[int(row)] for row, ok in zip(rows, finite, strict=True) if not ok]
        where = ", ".join(bad) or "this minibatch (no trajectory alone)"
        return Diverged(
            f"stage {self.stage.name}, epoch {self.progress.epoch + 1}: the log-likelihood of {where} is not "
            "finite; look at these demonstrations, raise control.std, or lower training.optimizer.lr"
        )
