"""Three planted levels of options as the world of a study (``world: planted_levels:WORLD``; SM 2.3).

A training seed has demonstrations of its own, drawn from a truth that is the same for all. Every method is scored on
further ones. Own methods:

- ``truth`` is the truth itself.
- ``limit`` and ``search`` find no levels. With the truth's lowest level they maximise the likelihood by EM, over what
  does not depend on the state. ``limit`` starts at the truth's own probabilities, ``search`` at random ones, as
  ``upper_levels: segments`` does.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from sklearn.metrics import normalized_mutual_info_score
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))
from planted import CONTROL, make_spec, make_truth, plant, recovered

from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.inference import log_likelihood, segment
from ddco_pyro.model.batch import encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.tables import Tables
from ddco_pyro.study.cells import Job
from ddco_pyro.training.upper import Constants, converged, fitted

COUNTS, STEPS = (4, 4, 2), 80
ENDING = -0.85  # a termination's logit: ψ = 0.3 at every level, once the levels below have ended


class Planted:
    """Demonstrations of a hierarchy that is known."""

    def __init__(self) -> None:
        self.methods = {
            "truth": lambda job: self._said(self.truth, job.starts),
            "limit": lambda job: self._constants(job, None),
            "search": lambda job: self._constants(job, job.cell.seed),
        }

    @property
    def truth(self) -> Hierarchy:
        """The hierarchy that made the demonstrations."""
        return make_truth(make_spec(COUNTS, control=CONTROL), ENDING)

    def collect(self, task: str, seeds: range, count: int, path: Path) -> None:
        """Draw demonstrations."""
        plant(self.truth, count, STEPS, seeds.start)[0].write(path)

    def play(self, task: str, fit: Fit, starts: range, folder: Path) -> Sequence[Mapping[str, float]]:
        """The NMI of each level with the truth, on a demonstration for each start."""
        return [{name: value for name, value in self._said(fit.hierarchy, starts).items() if name != "nats"}]

    def _said(self, model: Hierarchy, starts: range) -> dict[str, float]:
        truth = self.truth
        found = recovered(model, truth, *plant(truth, len(starts), STEPS, starts.start))
        return {"nats": found["found"], **_levels(found["found nmi"])}

    def _constants(self, job: Job, seed: int | None) -> dict[str, float]:
        """The likeliest constants of the training demonstrations; ``seed`` of random ones to begin at."""
        truth = self.truth
        held_out, choices = plant(truth, len(job.starts), STEPS, job.starts.start)
        train = job.demos.select(job.demos.masks["train"]).split(0.2, 0)[0]
        with torch.no_grad():
            batches = [encode(part, truth.encoder, truth.scaling) for part in (train, held_out)]
            pieces = [(truth.tabulate(batch), batch.lengths) for batch in batches]
        tables, lengths = pieces[1]
        selection = tuple(table[0, 0, :, 1:].double().exp() for table in tables.selection)
        start = Constants(selection, tuple(table[0, 0, :, 1].double().exp() for table in tables.termination[1:]))
        best = converged(pieces[:1], start) if seed is None else fitted(pieces[:1], seed)
        found = best.within(tables)
        segments = zip(choices.unbind(-1), segment(found, lengths), strict=True)
        scores = [float(normalized_mutual_info_score(*map(Tensor.flatten, pair))) for pair in segments]
        return {"nats": _per_step(found, lengths), **_levels(scores)}


def _levels(scores: Sequence[float]) -> dict[str, float]:
    return {f"NMI, level {level}": score for level, score in enumerate(scores, 1)}


def _per_step(tables: Tables, lengths: Tensor) -> float:
    return float(log_likelihood(tables, lengths).sum()) / int(lengths.sum())


WORLD = Planted()
