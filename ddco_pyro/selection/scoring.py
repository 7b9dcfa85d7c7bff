"""One fold of one candidate: trained on the rest, scored on what was held out."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from ddco_pyro.data.files import Damaged, json_text, write_text
from ddco_pyro.errors import BadInput, Failed
from ddco_pyro.evaluation.schema import read_record
from ddco_pyro.fitting.fit import Fit
from ddco_pyro.fitting.run import train
from ddco_pyro.inference.threads import one_thread
from ddco_pyro.selection.folds import Folds
from ddco_pyro.selection.grid import Candidate


@dataclass(frozen=True)
class Score:
    """What came of one fold of one candidate: ``log_likelihood`` in nats and ``steps`` of each held-out demonstration
    in ``names``; or why there is none, ``failed``.

    :param gradient_steps: that its training took.
    :param converged: False where its last stage had not converged when its budget ended.
    :param final: False where another attempt could go otherwise (out of memory); such a score is not kept.
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
        """Log-likelihood of all its demonstrations, nats."""
        return math.fsum(self.log_likelihood)


def score(folds: Folds, candidate: Candidate, fold: int) -> Score:
    """Train the candidate without the fold's demonstrations, and score it on them; on one thread, so that the numbers
    are the same in any process.

    Early stopping and the choice among restarts use a part of what it is trained with (``training.tune_fraction``).
    A fold that fails does not stop the others: the reason is in the score.
    """
    start = time.perf_counter()
    training, held_out = folds.split(fold)
    empty = Score(candidate.number, fold, held_out.names, held_out.lengths)
    try:
        with one_thread():
            trained = train(candidate.spec, folds.dimensions, training, held_out=held_out)
            values = tuple(Fit(candidate.spec, trained.hierarchy).log_likelihood(held_out).tolist())
    except (BadInput, Failed) as error:
        result = replace(empty, failed=str(error))
    except Exception as error:  # whatever it is, the other folds go on and the user is told
        reason = f"unexpected {type(error).__name__}: {' '.join(str(error).split())}"
        result = replace(empty, failed=reason, final=False)
    else:
        bad = [name for name, value in zip(held_out.names, values, strict=True) if not math.isfinite(value)]
        reason = f"the held-out log-likelihood of {', '.join(bad)} is not finite"
        ended = {
            "gradient_steps": trained.training["spent"]["gradient_steps"],
            "converged": trained.training["converged"],
        }
        result = replace(empty, failed=reason) if bad else replace(empty, log_likelihood=values, **ended)
    return replace(result, seconds=time.perf_counter() - start)


def path_of(folder: Path, candidate: int, fold: int) -> Path:
    """Where a score is kept."""
    return folder / "folds" / f"{candidate:03d}-{fold:02d}.json"


def keep(folder: Path, score: Score) -> None:
    """Write a score, whole or not at all, unless another attempt could go otherwise."""
    if score.final:
        write_text(path_of(folder, score.candidate, score.fold), json_text(asdict(score)))


def kept(folder: Path, candidate: int, fold: int) -> Score | None:
    """The score kept from before, if there is one.

    :raises Damaged: it cannot be read.
    """
    path = path_of(folder, candidate, fold)
    if not path.exists():
        return None
    remedy = "remove it and do the same again: this fold alone is trained anew"
    score = read_record(path, Score, remedy)
    lengths = (len(score.steps), len(score.names) if score.failed else len(score.log_likelihood))
    if (score.candidate, score.fold) != (candidate, fold) or {*lengths} != {len(score.names)} or 0 in score.steps:
        raise Damaged(path, "is not the score of this candidate and fold", remedy)
    return score
