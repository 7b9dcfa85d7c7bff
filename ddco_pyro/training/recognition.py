"""Learning a recogniser from labelled steps, and how much it counts (``training.labels.recogniser``)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.events import EpochEnded, OnEvent, ignore
from ddco_pyro.inference.paths import most_likely_path
from ddco_pyro.metrics import Candidate, Recogniser
from ddco_pyro.model.batch import Batch, encode
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.model.recogniser import Windows
from ddco_pyro.model.tables import Tables
from ddco_pyro.spec import with_overrides
from ddco_pyro.spec.training import RecogniserSpec
from ddco_pyro.statistics import edit_score
from ddco_pyro.training.checkpoint import Progress, Restart, TrainingData
from ddco_pyro.training.em import Expectation
from ddco_pyro.training.labels import Labels, choices
from ddco_pyro.training.loop import train
from ddco_pyro.training.objective import Objective
from ddco_pyro.training.optimizers import optimizer_of
from ddco_pyro.training.processes import Ranks
from ddco_pyro.training.stages import plan

ALONE = 1e-6
"""The power β of the controls' density under which a recogniser alone decides, with the transitions."""

PAIRS = ((ALONE, 0.3), (0.03, 0.1), (0.1, 0.3), (1.0, 1.0), (1.0, 0.0))
"""The pairs (β, γ) that models train and decode with: from the recogniser alone to labels alone."""

RIDGES = (15.0, 50.0, 150.0, 500.0)
"""The ridges of the recogniser that are tried."""

FOLDS = 4
"""The most parts of the labelled demonstrations that are left out in turn, and the parts of a single one."""

EM_STEPS = 4
"""EM steps of a model that decodes left-out demonstrations, with clamped starts and then with a candidate."""

ITERATIONS = 500
"""The most iterations of logistic regression."""

SHARES = (0.25, 0.75)
"""The half widths of windows, as parts of a labelled segment."""


def recognise(model: Hierarchy, data: TrainingData, demos: Demonstrations) -> tuple[TrainingData, Recogniser]:
    """Teach a hierarchy's recogniser the labelled steps, and say what it makes of the others.

    :param model: the hierarchy, with fitted encoder and scaling.
    :param demos: those to train and to tune with.
    :returns: the data with the power β of the control, and with starts and evidence of steps without labels;
        and how much the recogniser counts.
    """
    labels, own, recogniser = data.labels, data.spec.training.labels, model.recogniser
    assert labels and own and own.recogniser and recogniser  # noqa: PT018
    asked = RecogniserSpec() if own.recogniser == "cross_validated" else own.recogniser
    batch = encode(demos, model.encoder, model.scaling)
    options = choices(demos, own.source, labels.values, labels.demonstrations)
    widths = half_widths(typical_length(options.numpy()))
    features = {}
    for windows in (recogniser.around, recogniser.past):
        windows.widths.copy_(widths)
        features[windows] = windows.features(batch.inputs, batch.actions, batch.lengths)
    power, weight, ridge, tried = data.spec.control.power, asked.weight, asked.ridge, list[Candidate]()
    if own.recogniser == "cross_validated":
        tried = _tried(data, recogniser.around, features[recogniser.around], batch, options, demos.names)
        power, weight, ridge = chosen(tried)
    for windows, rows in features.items():
        learn(windows, rows[options > 0], options[options > 0], ridge)
    recogniser.gamma.fill_(weight)
    model.power.fill_(power)
    evidence, tuning = (
        torch.where((known >= 0).unsqueeze(-1), 0.0, recogniser.evidence(part))
        for known, part in ((labels.train, data.train), (labels.tune, data.tune))
    )
    starts = recogniser.options(data.train), recogniser.options(data.tune)
    taught = replace(labels, evidence=(evidence, tuning), starts=starts)
    learned = {f"recogniser.{name}": value.clone() for name, value in recogniser.state_dict().items()}
    spec = with_overrides(data.spec, {"control.power": power})
    found = Recogniser(power=power, weight=weight, ridge=ridge, widths=widths.tolist(), tried=tried)
    return replace(data, spec=spec, labels=taught, fitted=data.fitted | learned), found


def chosen(tried: Sequence[Candidate]) -> tuple[float, float, float]:
    """β, γ and the ridge: the pair with the best mean score over the ridges, then its best ridge.

    Few demonstrations are left out. A mean over ridges varies less than the best of them.
    """
    pairs: dict[tuple[float, float], list[Candidate]] = {}
    for candidate in tried:
        pairs.setdefault((candidate.power, candidate.weight), []).append(candidate)
    best = max(pairs.values(), key=lambda own: float(np.mean([candidate.score for candidate in own])))
    own = max(best, key=lambda candidate: candidate.score)
    return own.power, own.weight, own.ridge


def learn(windows: Windows, features: Tensor, options: Tensor, ridge: float) -> None:
    """Fit a regression to labelled steps.

    :param features: [M, 3 F].
    :param options: 1 to k, [M].
    :param ridge: precision of a normal prior on the weights of standardised features.
    """
    from sklearn.linear_model import LogisticRegression

    rows, known = features.numpy(), options.numpy() - 1
    middle, spread = rows.mean(0), rows.std(0)
    varying = spread > NARROWEST * np.abs(rows).max(0, initial=NARROWEST)
    spread = np.where(varying & ~windows.alike.numpy(), spread, 1.0)
    classes, counts = np.unique(known, return_counts=True)
    for buffer in (windows.weight, windows.bias, windows.share):
        buffer.zero_()
    windows.share[classes] = torch.as_tensor(counts / len(known))
    if len(classes) > 1:
        fitted = LogisticRegression(C=1 / ridge, max_iter=ITERATIONS).fit((rows - middle) / spread, known)
        classes = classes[-len(fitted.coef_) :]  # of two classes the first has no weights
        weight = fitted.coef_.T / spread[:, None]
        windows.weight[:, classes] = torch.as_tensor(weight)
        windows.bias[classes] = torch.as_tensor(fitted.intercept_ - middle @ weight)


NARROWEST = 1e-9
"""A feature varies where its standard deviation is a larger part of its largest value."""


def typical_length(options: Iterable[np.ndarray]) -> float:
    """The median length of labelled segments, from the option of each step [T]; below 1 for none."""
    lengths = []
    for own in options:
        edges = np.flatnonzero(np.diff(own, prepend=-2, append=-2))
        lengths.append(np.diff(edges)[own[edges[:-1]] > 0])
    return float(np.median(np.concatenate(lengths)))


def half_widths(typical: float) -> Tensor:
    """Half widths of windows in steps: a quarter and three quarters of a typical segment."""
    return torch.tensor([max(1, round(share * typical)) for share in SHARES])


def _tried(
    data: TrainingData,
    windows: Windows,
    features: Tensor,
    batch: Batch,
    options: Tensor,
    names: tuple[str, ...],
) -> list[Candidate]:
    """The candidates, each with its scores of the labelled steps that are left out.

    A model of the other labels decodes the left-out steps with each candidate. EM trains it on all
    demonstrations, the left-out ones unlabelled; gradient steps train a model on labelled ones alone.
    """
    assert data.labels is not None
    level, scores = data.labels.level, dict[tuple[float, float, float], list[tuple[float, float]]]()
    for hidden in _left_out(options, batch.lengths):
        known = torch.where(hidden, -1, options)
        ratios = {}
        for ridge in RIDGES:
            learn(windows, features[known > 0], known[known > 0], ridge)
            ratios[ridge] = windows.log_ratio(features)
        starts = torch.where(known < 0, ratios[RIDGES[1]][..., 1:].argmax(-1) + 1, known)
        begun = _begun(data, batch, starts, known, names)
        (rows,) = torch.where((hidden & (options > 0)).any(1))
        part, truth = batch.select(rows), torch.where(hidden, options, -1)[rows]
        for power, weight in PAIRS:
            model = _continued(data, begun, batch, known, power, weight * ratios[RIDGES[1]])
            with torch.no_grad():
                tables = model.tabulate(part)
            for ridge, ratio in ratios.items():
                evident = tables.with_evidence(level, weight * ratio[rows, : tables.steps])
                path = most_likely_path(evident, part.lengths).choices[level - 1]
                own = scores.setdefault((power, weight, ridge), [])
                for found, true in zip(path.numpy(), truth[:, : tables.steps].numpy(), strict=True):
                    ours, theirs = found[true > 0], true[true > 0]
                    own.append((float((ours == theirs).mean()), edit_score(ours, theirs)))
    means = {key: np.mean(own, axis=0).tolist() for key, own in scores.items()}
    return [
        Candidate(power=power, weight=weight, ridge=ridge, accuracy=accuracy, edit=edit)
        for (power, weight, ridge), (accuracy, edit) in means.items()
    ]


def _left_out(options: Tensor, lengths: Tensor) -> Iterator[Tensor]:
    """Steps that are left out together, bool [N, T]: of whole demonstrations, or parts of a single one."""
    (labelled,) = torch.where((options > 0).any(1))
    fold = torch.full_like(options, -1)
    if len(labelled) == 1:
        fold[labelled] = torch.arange(options.shape[1]) * FOLDS // lengths[labelled]
    else:
        fold[labelled] = (torch.arange(len(labelled)) % FOLDS).unsqueeze(1)
    for number in range(FOLDS):
        hidden = fold == number
        if bool((hidden & (options > 0)).any()) and bool((~hidden & (options > 0)).any()):
            yield hidden


def _begun(
    data: TrainingData, batch: Batch, starts: Tensor, known: Tensor, names: tuple[str, ...]
) -> Hierarchy:
    """A model whose options begin as the labels say, and as the recogniser says of other steps."""
    assert data.labels is not None
    model = data.hierarchy(0)
    if optimizer_of(data.spec.training.optimizer, model) == "em":
        return by_em(data, model, batch, replace(data.labels, train=starts, tune=starts))
    (rows,) = torch.where((known > 0).any(1))
    part, known = batch.select(rows), known[rows, : int(batch.lengths[rows].max())]
    labels = replace(data.labels, train=known, tune=known)
    changes = {"training.starts": data.spec.training.starts[:1]}
    spec, names = with_overrides(data.spec, changes), tuple(names[row] for row in rows.tolist())
    alone = replace(data, spec=spec, train=part, tune=part, labels=labels, names=names)
    restart, ranks = Restart(Progress(0)), Ranks.here()
    for work in (alone, (restart, None)):  # all processes of torchrun train it
        ranks.share(work)
    restart = train(alone, restart)
    ranks.share(None)
    return alone.hierarchy(0, restart.states["best"])


def _continued(
    data: TrainingData, begun: Hierarchy, batch: Batch, known: Tensor, power: float, evidence: Tensor
) -> Hierarchy:
    """The model after some EM steps with a power and evidence of the steps without labels."""
    assert data.labels is not None
    model = data.hierarchy(0, begun.state_dict())
    model.power.fill_(power)
    if optimizer_of(data.spec.training.optimizer, model) != "em":
        return model
    evidence = torch.where((known > 0).unsqueeze(-1), 0.0, evidence)
    labels = replace(data.labels, train=known, tune=known, evidence=(evidence, evidence))
    return by_em(data, model, batch, labels)


def by_em(
    data: TrainingData,
    model: Hierarchy,
    batch: Batch,
    labels: Labels,
    number: int = EM_STEPS,
    on_event: OnEvent = ignore,
) -> Hierarchy:
    """The model after so many EM steps of all its networks, with these labels in place of the data's.

    A step is an epoch of the events.
    """
    stage = plan(data.spec, model.depth)[-1]
    objective = Objective(replace(data, train=batch, tune=batch, labels=labels), Progress(0), stage)

    def score(tables: Tables, piece: Batch, rows: Tensor) -> Tensor:
        return objective.values(objective.clamped(tables, rows), piece.lengths).sum()

    steps = Expectation(model, stage.trained, score, data.spec.training.optimizer.ridge)
    for epoch in range(1, number + 1):
        value = steps.step(batch) / batch.steps
        on_event(EpochEnded(0, stage.name, epoch, value, value))
    return model
