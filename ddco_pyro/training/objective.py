"""What a stage of training maximises."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from statistics import median

import torch
from torch import Tensor

from ddco_pyro.data.reading import Job
from ddco_pyro.errors import Failed
from ddco_pyro.inference.engines import log_likelihood, total_log_likelihood
from ddco_pyro.model.encoding import Batch
from ddco_pyro.model.frames import Frames
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.tables import Tables
from ddco_pyro.training.checkpoint import Progress
from ddco_pyro.training.duration import log_duration_prior
from ddco_pyro.training.initialization import Clusters, EqualParts
from ddco_pyro.training.material import Material
from ddco_pyro.training.ranks import ALONE, Ranks
from ddco_pyro.training.stages import Stage
from ddco_pyro.training.upper import Constants, expected, fitted


class TrainingError(Failed):
    """Training cannot go on: the message names the trajectory or the checkpoint and says what to do."""


class Diverged(TrainingError):
    """A log-likelihood of training demonstrations that is NaN or infinite: this restart has no further epoch."""


Known = dict[int, Tensor]
"""By level: the choice of each step that is known, [N, T]; -1 where it is free."""


class Objective:
    """What a stage maximises: the log-likelihood with the choices that are known, and the log-prior of durations.

    Where networks take over :attr:`constants`, the expected log-probability of selections and terminations is in the
    place of the log-likelihood. Where levels and meta-policy are trained apart it is the sum of two, and their mean is
    what is said of it.
    """

    def __init__(self, material: Material, progress: Progress, stage: Stage, ranks: Ranks = ALONE) -> None:
        self.material, self.progress, self.stage, self.ranks = material, progress, stage, ranks
        self.known: tuple[Known, Known] = {}, {}
        self.constants: Constants | None = None
        self._varied: tuple[tuple[int, int, int], Batch] | None = None
        self._likelihoods = 2 if stage.selecting else 1
        labels = material.labels
        if labels is not None and labels.matter_in(stage):
            self.known = {labels.level: labels.train}, {labels.level: labels.tune}
        if stage.clamped is not None:
            self._clamp_to_start(stage.clamped)

    def _clamp_to_start(self, level: int) -> None:
        """Where a step has no label its cluster, or the part of the demonstration it is in, is its choice."""
        material, hierarchy = self.material, self.material.spec.hierarchy
        assert hierarchy is not None  # only levels are clamped
        kind, count = material.spec.training.initialize, hierarchy.levels[level - 1].count
        if kind == "equal_parts":
            start: EqualParts | Clusters = EqualParts(count)
        else:
            seed = material.seed(self.progress.restart, self.progress.stage)
            labels, read = self.known[0].get(level), hierarchy.read_by(level)
            start = Clusters(material.train, count, seed, kind == "vq_controls", labels, read)
        for known, batch in zip(self.known, (material.train, material.tune), strict=True):
            choices = start.choices(batch)
            labelled = known.get(level, choices)
            known[level] = torch.where(labelled < 0, choices, labelled)

    def find_constants(self, model: Hierarchy) -> None:
        """Those that the networks are to take over, given the lowest level of the model; none in other stages."""
        if self.stage.from_constants:
            with torch.no_grad():
                pieces = [
                    (self._tables(model, piece, self.known[0], rows), piece.lengths)
                    for rows, piece in self.material.train.pieces(model.steps_at_once)
                ]
            self.constants = fitted(pieces, self.material.seed(self.progress.restart, self.progress.stage))

    def ascend(self, model: Hierarchy, rows: Tensor, steps: int | None = None) -> float:
        """Add the gradient of the loss of some training demonstrations to the parameters'; what they add to what is
        maximised.

        The loss is minus that per step. A batch that is long is processed in parts.

        :param steps: of the minibatch that they are a shard of; None where they are all of it.
        """
        batch, total = self._seen(model).select(rows), 0.0
        for part, piece in batch.pieces(model.steps_at_once):
            tables = self._tables(model, piece, self.known[0], rows[part])
            value = self._total(tables, piece)
            if not bool(torch.isfinite(value.detach())):
                raise self._not_finite(tables, piece, rows[part])
            (-value / (steps or batch.steps)).backward()
            total += float(value.detach())
        return total / self._likelihoods

    def read_ahead(self, model: Hierarchy, shards: Sequence[Tensor]) -> None:
        """Have the pictures of shards of an epoch's minibatches read before :meth:`ascend` asks for them."""
        seen = self._seen(model)
        _read_ahead(
            model, seen, (piece for rows in shards for _, piece in seen.select(rows).pieces(model.steps_at_once))
        )

    def _seen(self, model: Hierarchy) -> Batch:
        """The training demonstrations as they are seen in this epoch."""
        epoch = self.progress.restart, self.progress.stage, self.progress.epoch
        if self._varied is None or self._varied[0] != epoch:
            self._varied = epoch, self.material.train.varied(model.encoder.shifts, self.material.seed(*epoch))
        return self._varied[1]

    def tune(self, model: Hierarchy) -> float:
        """What is maximised of the tuning demonstrations, per step: the mean, or the median over demonstrations."""
        tune, by_median = self.material.tune, self.material.spec.training.tune_by == "median"
        pieces = list(tune.pieces(1 if by_median else model.steps_at_once))  # one demonstration each
        with torch.no_grad():
            _read_ahead(model, tune, (piece for _, piece in self.ranks.own(pieces)))
            values = list(self.ranks.each(partial(self._tuned, model, *piece) for piece in pieces))
        if by_median:
            return median(value / piece.steps for value, (_, piece) in zip(values, pieces, strict=True))
        return sum(values) / tune.steps

    def _tuned(self, model: Hierarchy, rows: Tensor, batch: Batch) -> float:
        return float(self._total(self._tables(model, batch, self.known[1], rows), batch)) / self._likelihoods

    def _tables(self, model: Hierarchy, batch: Batch, known: Known, rows: Tensor) -> Tables:
        tables = model.tabulate(batch, self.stage.discovering)
        for level, choices in known.items():
            tables = tables.clamp(level, choices[rows, : batch.inputs.batch[1]])
        return tables

    def _total(self, tables: Tables, batch: Batch) -> Tensor:
        likelihood = partial(total_log_likelihood, lengths=batch.lengths, engine=self.material.spec.inference.engine)
        if self.constants is not None:
            value = expected(tables, batch.lengths, self.constants)
        elif self.stage.selecting:
            levels, meta_policy = tables.apart()
            value = likelihood(levels) + likelihood(meta_policy)
        else:
            value = likelihood(tables)
        prior = self.material.spec.training.duration
        if prior is None:
            return value
        return value + log_duration_prior(tables.termination, batch.lengths, prior) / self.material.train.steps

    def _not_finite(self, tables: Tables, batch: Batch, rows: Tensor) -> Diverged:
        with torch.no_grad():
            values = log_likelihood(tables, batch.lengths)
        bad = [self.material.names[int(row)] for row, ok in zip(rows, torch.isfinite(values), strict=True) if not ok]
        where = ", ".join(bad) or "this minibatch (no trajectory alone)"
        return Diverged(
            f"stage {self.stage.name}, epoch {self.progress.epoch + 1}: the log-likelihood of {where} is not "
            "finite; look at these demonstrations, raise control.std, or lower training.optimizer.lr"
        )


def _read_ahead(model: Hierarchy, whole: Batch, pieces: Iterable[Batch]) -> None:
    """Have the pictures of these pieces of a batch read in the order in which the networks will ask for them."""
    if isinstance(whole.inputs.images, Frames):
        whole.inputs.images.readers.plan(_jobs(model, pieces))


def _jobs(model: Hierarchy, pieces: Iterable[Batch]) -> Iterator[Job]:
    """Chunk after chunk; where there are several and a gradient is asked for, then once more, the last first."""
    for piece in pieces:
        chunks = model.chunks(piece.inputs)
        again = chunks[::-1] if len(chunks) > 1 and model.training else []
        for chunk in (*chunks, *again):
            assert isinstance(chunk.images, Frames)  # it is a part of such a piece
            yield chunk.images.job
