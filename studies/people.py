"""Gestures of surgeons (JIGSAWS): options without and with a few labels, beside what else a user would try.

    python -m studies.people --data FOLDER [--tasks Knot_Tying Suturing] [--splits last surgeon trial]
        [--labelled 0 1 3 5 all] [--jobs 2]

FOLDER holds ``TASK.hdf5``, of ``ddco-pyro import JIGSAWS/TASK --hz 10``. No licence lets anyone share these
data; Johns Hopkins University gives them on request.

``last`` holds out the last trial of each surgeon. ``trial`` and ``surgeon`` are the official splits: each
trial, and each surgeon, is held out in turn. The spec is what ``ddco-pyro init`` writes for the training
demonstrations. Labelled demonstrations are spread evenly over them. A cell that was done is not done again.
Adds its numbers to ``docs/results/people.csv``.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from sklearn.cluster import KMeans
from sklearn.decomposition import PCA
from sklearn.metrics import normalized_mutual_info_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement, confusion, equal_lengths
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.model.batch import encode
from ddco_pyro.model.recogniser import observed, window_means
from ddco_pyro.selection.small import decide
from ddco_pyro.spec import parse_spec, with_overrides
from ddco_pyro.spec.yaml import read_yaml
from ddco_pyro.statistics import edit_score
from studies import study
from studies.study import Cell, Row, Settings, described

LABELS, KNOWN = "gesture", "known"
ALL, SPLITS = "all", ["last", "surgeon", "trial"]
SECOND = 10  # steps
DEFAULTS = Settings({"seed": 0}, Path("runs/people"))


@dataclass(frozen=True)
class PeopleCell(Cell):
    """A task, what is held out, and how many training demonstrations have their labels."""

    data: str
    task: str
    fold: str
    labelled: str

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.task}-{self.fold}-{self.labelled}"

    def results(self, settings: Settings, folder: Path) -> dict[str, Any]:
        """Fit, and compare with the gestures of the held-out demonstrations."""
        path = Path(self.data) / f"{self.task}.hdf5"
        demos = divided(labelled_demonstrations(path), self.fold)
        train, valid = (demos.select(demos.masks[part]) for part in ("train", "valid"))
        others = [name for name in Demonstrations.read(path).names if name not in train.names]
        facts = inspect(path, exclude=others)
        plain = parse_spec(read_yaml(starting_spec(replace(facts, excluded=(), masks={}), path).text))
        small = decide(plain, replace(train, masks={}), demos.frequency)
        text = starting_spec(replace(facts, excluded=(), masks={}), path, decided=small).text
        spec = with_overrides(parse_spec(read_yaml(text)), ALONE | {"seed": settings.values["seed"]})
        truth = [demo.labels[LABELS] for demo in valid]
        count = spec.hierarchy.levels[0].count if spec.hierarchy else 1
        if self.labelled == "0":
            found, typical = fit(spec, demos), typical_length(demo.labels[LABELS] for demo in train)
            kinds = {"options": list(found.segment(valid)[0])}
            kinds["windowed k-means"] = clusters(found, train, valid, count)
            states = autoregressive(train, valid, count, typical)
            kinds |= dict(zip(("AR-HMM", "AR-HMM, sticky"), states, strict=True))
            kinds["options, β = 1"] = list(fit(with_overrides(spec, USUAL), demos).segment(valid)[0])
            asked = decide(plain, replace(train, masks={}), demos.frequency, typical)
            as_asked = starting_spec(replace(facts, excluded=(), masks={}), path, decided=asked).text
            alone = ALONE | {"seed": settings.values["seed"]}
            longer = with_overrides(parse_spec(read_yaml(as_asked)), alone)
            kinds["options, --segment"] = list(fit(longer, demos).segment(valid)[0])
            kinds["equal lengths"] = [equal_lengths(len(demo), count) for demo in valid]
            named = {name: matched(own, truth) for name, own in kinds.items()}
            return {"scores": {name: scored(own, kinds[name], truth) for name, own in named.items()}}
        given = {"level": "option", "from": KNOWN}
        own = with_labels(demos, train, len(train) if self.labelled == ALL else int(self.labelled))
        found = fit(with_overrides(spec, {"training.labels": given | {"recogniser": "cross_validated"}}), own)
        alone = [row[:steps].numpy() for piece in found.infer(valid) for row, steps in recognised(piece)]
        kinds = {"options": list(found.segment(valid)[0]), "recogniser": alone}
        if self.fold == "last":
            clamped = fit(with_overrides(spec, {"training.labels": given, "control.power": 1.0}), own)
            kinds["labels alone, β = 1"] = list(clamped.segment(valid)[0])
        chosen = found.metrics.training.recogniser
        assert chosen is not None  # it has one
        only = {"recogniser": {"weight": ALONE_WEIGHT, "ridge": chosen.ridge}}
        smooth = fit(with_overrides(spec, {"training.labels": given | only, "control.power": NOTHING}), own)
        kinds["recogniser, transitions"] = list(smooth.segment(valid)[0])
        values = found.metrics.trained_labels
        assert values is not None  # it trains on labels
        names = np.array([-9, *values.values, *[-9] * count])
        return {
            "scores": {name: scored([names[row] for row in own], own, truth) for name, own in kinds.items()},
            "chosen": {"power": chosen.power, "weight": chosen.weight, "ridge": chosen.ridge},
        }

    def rows(self, results: Mapping[str, Any]) -> Iterator[Row]:
        """Agreement of each method, and what cross-validation chose; the fold stands for the seed."""
        split, _, own = self.fold.partition("-")
        for method, scores in {**results["scores"], "chosen": results.get("chosen", {})}.items():
            for measure, value in scores.items():
                named = f"{method}, {self.labelled} labelled"
                yield Row(split, self.task, named, None, own or 0, measure, value)


ALONE: dict[str, Any] = {"compare_with": []}
NOTHING, ALONE_WEIGHT = 1e-6, 0.3
"""The power with which controls count nothing, and the recogniser's weight beside transitions."""
USUAL: dict[str, Any] = {
    "control.power": 1.0,
    "control.parts": [],
    "training.starts": ["vq_controls"],
    "training.optimizer.ridge": {"cross_validated": True},
}
"""What the paper's likelihood is, with small ridges."""


def labelled_demonstrations(path: Path) -> Demonstrations:
    """The demonstrations that have gestures."""
    if not path.is_file():
        remedy = f"make it with: ddco-pyro import JIGSAWS/{path.stem} --out {path} --hz 10"
        raise BadInput(f"{path}: is missing; {remedy}")
    demos = Demonstrations.read(path, labels=[LABELS])
    names = [demo.name for demo in demos if (demo.labels[LABELS] >= 0).any()]
    return demos.select(names)


def folds(demos: Demonstrations, split: str) -> list[str]:
    """The folds of a split by name."""
    if split == "last":
        return ["last"]
    return [f"{split}-{value}" for value in sorted({str(demo.attributes[split]) for demo in demos})]


def divided(demos: Demonstrations, fold: str) -> Demonstrations:
    """The demonstrations with masks of a fold."""
    split, _, value = fold.partition("-")
    if split == "last":
        of: dict[str, list[tuple[int, str]]] = {}
        for demo in demos:
            trial = (int(demo.attributes["trial"]), demo.name)
            of.setdefault(str(demo.attributes["surgeon"]), []).append(trial)
        valid = {max(trials)[1] for trials in of.values()}
    else:
        valid = {demo.name for demo in demos if str(demo.attributes[split]) == value}
    masks = {"train": tuple(name for name in demos.names if name not in valid), "valid": tuple(sorted(valid))}
    return replace(demos, masks=masks)


def with_labels(demos: Demonstrations, train: Demonstrations, number: int) -> Demonstrations:
    """The labels of so many training demonstrations, spread over them in order; -1 in others."""
    chosen = {train.names[place] for place in np.linspace(0, len(train) - 1, number).round().astype(int)}
    labels = [np.where(demo.name in chosen, demo.labels[LABELS], -1) for demo in demos]
    pairs = zip(demos, labels, strict=True)
    known = tuple(replace(demo, labels={**demo.labels, KNOWN: own}) for demo, own in pairs)
    return replace(demos, demonstrations=known)


def typical_length(labels: Iterable[np.ndarray]) -> float:
    """The median steps of a segment, over all demonstrations; -1 is no segment."""
    lengths = []
    for row in labels:
        edges = np.flatnonzero(np.diff(row, prepend=-2, append=-2))
        lengths.append(np.diff(edges)[row[edges[:-1]] >= 0])
    return float(np.median(np.concatenate(lengths)))


def clusters(found: Fit, train: Demonstrations, valid: Demonstrations, count: int) -> list[np.ndarray]:
    """k-means on observations and controls averaged over a second before and after each step."""
    model, rows = found.hierarchy, []
    for part in (train, valid):
        batch = encode(part, model.encoder, model.scaling)
        x = torch.cat([observed(batch.inputs), batch.actions.double()], dim=-1)
        features = window_means(x, batch.lengths, SECOND, SECOND).numpy()
        rows.append([own[:length] for own, length in zip(features, batch.lengths.tolist(), strict=True)])
    fitted = KMeans(count, n_init=10, random_state=0).fit(np.concatenate(rows[0]))
    return [fitted.predict(own) for own in rows[1]]


def autoregressive(
    train: Demonstrations, valid: Demonstrations, count: int, typical: float
) -> Iterator[list[np.ndarray]]:
    """States of dynamax' AR-HMM, without stickiness, and with one whose segments are as long as asked.

    It sees whitened principal directions of observations and controls, and predicts each step from the last.

    :param typical: the median steps that are asked for, of the segments of the training demonstrations.
    """
    import jax
    from dynamax.hidden_markov_model import LinearAutoregressiveHMM

    jax.config.update("jax_enable_x64", True)
    arrays = [[*demo.observations.values(), demo.actions] for demo in (*train, *valid)]
    rows = [np.concatenate(own, 1, dtype=float) for own in arrays]
    whitening = make_pipeline(StandardScaler(), PCA(DIRECTIONS, whiten=True))
    whitened = whitening.fit(np.concatenate(rows[: len(train)]))
    rows = [whitened.transform(row) for row in rows]
    ours, parts = rows[: len(train)], (slice(1, None), slice(-1))
    after, before = (np.concatenate([row[part] for row in ours]) for part in parts)
    tried = []
    for stickiness in STICKINESS:
        model = LinearAutoregressiveHMM(count, DIRECTIONS, transition_matrix_stickiness=stickiness)
        start = model.initialize(jax.random.PRNGKey(0), method="kmeans", emissions=after)
        learned, _ = model.fit_em(*start, after, inputs=before, num_iters=50, verbose=False)
        states = [*_states(model, learned, rows[: len(train)]), *_states(model, learned, rows[len(train) :])]
        median = typical_length(states[: len(train)])
        tried.append((abs(math.log(median / typical)), stickiness, states[len(train) :]))
    yield tried[0][-1]
    yield min(tried)[-1]


def _states(model: Any, learned: Any, rows: list[np.ndarray]) -> list[np.ndarray]:
    """The states of each demonstration, from 1, all as one sequence, as in the fit; the 1st as the 2nd."""
    after, before = (np.concatenate([row[part] for row in rows]) for part in (slice(1, None), slice(-1)))
    states = np.asarray(model.most_likely_states(learned, after, inputs=before)) + 1
    own = np.split(states, np.cumsum([len(row) - 1 for row in rows])[:-1])
    return [np.insert(one, 0, one[0]) for one in own]


DIRECTIONS, STICKINESS = 10, (0.0, *(10.0**power for power in range(3, 9)))
"""Of an AR-HMM: the principal directions that it sees, and the pseudo-counts of staying that are tried."""


def recognised(piece: Any) -> Iterator[tuple[Any, int]]:
    """The options that the recogniser alone finds, and the steps, of each demonstration."""
    return zip(piece.recognised, piece.lengths, strict=True)


def matched(kinds: list[np.ndarray], truth: list[np.ndarray]) -> list[np.ndarray]:
    """Kinds as the labels that they are matched with, one for all demonstrations; -9 for none."""
    table = confusion(kinds, truth)
    pairs = zip(table.options, table.matched, strict=True)
    label = {kind: -9 if name is None else name for kind, name in pairs}
    return [np.array([label.get(kind, -9) for kind in own.tolist()]) for own in kinds]


def scored(named: list[np.ndarray], kinds: list[np.ndarray], truth: list[np.ndarray]) -> dict[str, float]:
    """Over labelled steps: the share that is right, the mean edit score, the NMI, segments in a
    demonstration, and F1 of segments and of boundaries.
    """
    known = [label >= 0 for label in truth]
    right = np.concatenate([(own == label)[at] for own, label, at in zip(named, truth, known, strict=True)])
    edits = [edit_score(own[at], label[at]) for own, label, at in zip(named, truth, known, strict=True)]
    pairs = (zip(part, known, strict=True) for part in (kinds, truth))
    ours, theirs = (np.concatenate([own[at] for own, at in each]) for each in pairs)
    segments = [1 + int((np.diff(own[at]) != 0).sum()) for own, at in zip(kinds, known, strict=True)]
    found = agreement(named, truth)
    assert found is not None  # there are labels
    return {
        "accuracy": float(right.mean()),
        "edit": float(np.mean(edits)),
        "NMI": float(normalized_mutual_info_score(theirs, ours)),
        "segments": float(np.mean(segments)),
        "F1@50": found.matched_globally.f1_50,
        "boundary F1": found.boundary_f1_3,
    }


def cells(own: argparse.Namespace) -> list[Cell]:
    """All of a split before another."""
    found: list[Cell] = []
    for split, task in itertools.product(own.splits, own.tasks):
        demos = labelled_demonstrations(own.data / f"{task}.hdf5")
        names = folds(demos, split)
        data, each = str(own.data), itertools.product(names, own.labelled)
        found += [PeopleCell(data, task, fold, labelled) for fold, labelled in each]
    return found


def main() -> None:
    """Run the study."""
    parser = described(__doc__)
    parser.add_argument("--data", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--tasks", nargs="+", default=["Knot_Tying", "Suturing"], metavar="TASK")
    parser.add_argument("--splits", nargs="+", default=SPLITS, choices=SPLITS)
    parser.add_argument("--labelled", nargs="+", default=["0", "1", "3", "5", ALL])
    study.main("people", parser, DEFAULTS, cells)


if __name__ == "__main__":
    main()
