"""What a stage of training maximises."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ddco_pyro.errors import Failed
from ddco_pyro.fitting.clusters import Clusters, EqualParts
from ddco_pyro.fitting.stages import Stage
from ddco_pyro.inference import log_likelihood, total_log_likelihood
from ddco_pyro.model.encoding import Batch
from ddco_pyro.model.hierarchy import Hierarchy

if TYPE_CHECKING:
    from ddco_pyro.fitting.training import Training


class TrainingError(Failed):
    """Training cannot go on: the message names the trajectory or the checkpoint and says what to do."""


class Objective:
    """What a stage maximises: the log-likelihood, with the choices of one level clamped where the stage says so."""

    def __init__(self, trainer: Training, stage: Stage) -> None:
        self.trainer, self.stage = trainer, stage
        self.clusters: tuple[Tensor, Tensor] | None = None
        if stage.clamped is not None:
            hierarchy = trainer.spec.hierarchy
            assert hierarchy is not None  # only levels are clamped
            seed = trainer._seed(trainer.progress.restart, trainer.progress.stage)
            options, kind = hierarchy.levels[stage.clamped - 1].count, trainer.spec.training.initialize
            clusters = (
                EqualParts(options)
                if kind == "equal_parts"
                else Clusters(trainer.train, options, seed, kind == "vq_controls")
            )
            self.clusters = clusters.choices(trainer.train), clusters.choices(trainer.tune)

    def ascend(self, model: Hierarchy, rows: Tensor) -> float:
        """Add the gradient of the loss of some training demonstrations to the parameters'; their log-likelihood.

        The loss is minus the log-likelihood per step. A batch that is long is processed in parts.
        """
        batch, total = self.trainer.train.select(rows), 0.0
        for part, piece in batch.pieces(model.steps_at_once):
            value = self._total(model, piece, None if self.clusters is None else self.clusters[0][rows[part]])
            if not bool(torch.isfinite(value.detach())):
                raise self._not_finite(model, piece, rows[part])
            (-value / batch.steps).backward()
            total += float(value.detach())
        return total

    def tune(self, model: Hierarchy) -> float:
        """Log-likelihood per step of the tuning demonstrations."""
        choices = None if self.clusters is None else self.clusters[1]
        with torch.no_grad():
            values = [
                float(self._total(model, piece, None if choices is None else choices[part]))
                for part, piece in self.trainer.tune.pieces(model.steps_at_once)
            ]
        return sum(values) / self.trainer.tune.steps

    def _total(self, model: Hierarchy, batch: Batch, choices: Tensor | None) -> Tensor:
        tables = model.tabulate(batch, self.stage.discovering)
        if choices is not None and self.stage.clamped is not None:
            tables = tables.clamp(self.stage.clamped, choices[:, : batch.inputs.batch[1]])
        return total_log_likelihood(tables, batch.lengths, self.trainer.spec.inference.engine)

    def _not_finite(self, model: Hierarchy, batch: Batch, rows: Tensor) -> TrainingError:
        with torch.no_grad():
            values = log_likelihood(model.tabulate(batch, self.stage.discovering), batch.lengths)
        bad = [self.trainer.names[int(row)] for row, ok in zip(rows, torch.isfinite(values), strict=True) if not ok]
        where = ", ".join(bad) or "this minibatch (no trajectory alone)"
        return TrainingError(
            f"stage {self.stage.name}, epoch {self.trainer.progress.epoch + 1}: the log-likelihood of {where} is not "
            "finite; look at these demonstrations, raise control.std, or lower training.optimizer.lr"
        )
