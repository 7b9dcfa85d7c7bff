"""Folds of a cross-validation: the same for every candidate, trained in parallel, each score kept in a file."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import Damaged, json_text, write_text
from ddco_pyro.errors import BadInput, Failed, reason
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.metrics import read_record
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.processes import one_thread
from ddco_pyro.training.restarts import train_model


class FoldError(BadInput):
    """Demonstrations that cannot be divided into so many folds."""


@dataclass(frozen=True)
class Folds:
    """Demonstrations ``demos`` and, for each fold, the names of the ``held_out`` ones.

    :param dimensions: those of all demonstrations, so that networks are the same in every fold and in the final fit.
    """

    demos: Demonstrations
    held_out: tuple[tuple[str, ...], ...]
    dimensions: Dimensions

    def split(self, fold: int) -> tuple[Demonstrations, Demonstrations]:
        """The training demonstrations and the held-out demonstrations of a fold."""
        out = set(self.held_out[fold])
        train = [name for name in self.demos.names if name not in out]
        return self.demos.select(train), self.demos.select(self.held_out[fold])


def divide(demos: Demonstrations, folds: int, seed: int) -> Folds:
    """Folds over all demonstrations; over the training ones alone where the file has masks for that.

    :raises FoldError: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    used = demos.split(0.5, seed)[0] if demos.masks.keys() & {"train", "valid"} else demos
    held_out = tuple(tuple(used.names[row] for row in rows) for rows in assign(len(used), folds, seed))
    return Folds(used, held_out, replace(Dimensions.of(demos), steps=max(used.lengths)))


def assign(count: int, folds: int, seed: int) -> list[list[int]]:
    """The numbers of the demonstrations held out in each fold: a partition of 0 to count - 1, as even as possible.

    :raises FoldError: there are fewer demonstrations than folds, or too few to train and tune with.
    """
    from sklearn.model_selection import KFold

    if folds > count:
        raise FoldError(f"selection.folds: {folds} folds of {count} demonstrations; use at most {count}")
    if count - -(-count // folds) < 2:
        raise FoldError(f"selection.folds: {folds} folds of {count} demonstrations leave less than 2 to train with")
    shuffled = KFold(folds, shuffle=True, random_state=seed).split(np.zeros(count))
    return [sorted(int(row) for row in held_out) for _, held_out in shuffled]


@dataclass(frozen=True)
class Score:
    """The result of one fold of one candidate.

    :param log_likelihood: of each demonstration in ``names``, nats; empty where the fold failed.
    :param steps: of each demonstration.
    :param failed: why there is no log-likelihood; else empty.
    :param gradient_steps: of the training.
    :param converged: whether the last stage of training had converged.
    :param final: False where the failure may be transient, so that it is not kept.
    """

    candidate: int
    fold: int
    names: tuple[str, ...]
    steps: tuple[int, ...]
    log_likelihood: tuple[float, ...] = ()
    failed: str = ""
    gradient_steps: int = 0
    converged: bool = True
    final: bool = True
    seconds: float = 0.0

    @property
    def total(self) -> float:
        """Log-likelihood of all demonstrations, nats."""
        return math.fsum(self.log_likelihood)


def score(folds: Folds, candidate: Candidate, fold: int) -> Score:
    """Train a candidate without a fold's demonstrations and score them, on one thread for the same bits anywhere.

    Early stopping and the choice among restarts use a part of the training demonstrations
    (``training.tune_fraction``). A failure is a part of the score and does not stop other folds.
    """
    start = time.perf_counter()
    training, held_out = folds.split(fold)
    empty = Score(candidate.number, fold, held_out.names, held_out.lengths)
    try:
        with one_thread():
            trained = train_model(candidate.spec, folds.dimensions, training, held_out=held_out)
            values = tuple(Fit(candidate.spec, trained.hierarchy).log_likelihood(held_out).tolist())
        bad = [name for name, value in zip(held_out.names, values, strict=True) if not math.isfinite(value)]
        if bad:
            raise Failed(f"the held-out log-likelihood of {', '.join(bad)} is not finite")
        steps, converged = trained.summary["spent"]["gradient_steps"], trained.summary["converged"]
        result = replace(empty, log_likelihood=values, gradient_steps=steps, converged=converged)
    except Exception as error:  # other folds go on, and the reason is shown
        result = replace(empty, failed=reason(error), final=isinstance(error, BadInput | Failed))
    return replace(result, seconds=time.perf_counter() - start)


def score_path(folder: Path, candidate: int, fold: int) -> Path:
    """The file of a score."""
    return folder / "folds" / f"{candidate:03d}-{fold:02d}.json"


def keep_score(folder: Path, score: Score) -> None:
    """Write a score, whole or not at all, unless its failure may be transient."""
    if score.final:
        write_text(score_path(folder, score.candidate, score.fold), json_text(asdict(score)))


def kept_score(folder: Path, folds: Folds, candidate: int, fold: int) -> Score | None:
    """The score in the folder, if there is one.

    :raises Damaged: the file cannot be read.
    """
    path = score_path(folder, candidate, fold)
    if not path.exists():
        return None
    remedy = "remove it and do the same again: this fold alone is trained anew"
    score = read_record(path, Score, remedy)
    lengths = (len(score.steps), len(score.names) if score.failed else len(score.log_likelihood))
    known = (score.candidate, score.fold, score.names) == (candidate, fold, folds.held_out[fold])
    if not known or {*lengths} != {len(score.names)} or 0 in score.steps:
        raise Damaged(path, "is not the score of this candidate and fold", remedy)
    return score
