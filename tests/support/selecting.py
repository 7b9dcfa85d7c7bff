"""A small selection for tests: demonstrations of a point, a grid, and fits of folds without any training."""

from dataclasses import astuple

import numpy as np
from made_metrics import made_metrics
from random_demonstrations import numbered

from ddco_pyro.events import CellDone, CellsBegan
from ddco_pyro.metrics import Metrics
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.spec import load_spec, parse_spec


class Told:
    """What a selection told whoever watches it."""

    def __init__(self):
        self.begun, self.pairs = [], []

    def __call__(self, event):
        kinds = {CellsBegan: self.begun, CellDone: self.pairs}
        kinds.get(type(event), []).append(astuple(event))


def two_skills(count=12, steps=8, seed=0):
    """Demonstrations in which the sign of the control turns half way."""
    random, rows = np.random.default_rng(seed), []
    for number in range(count):
        place = random.normal(size=(steps + number % 3, 2))
        turn = np.where(np.arange(len(place)) < steps // 2, 1.0, -1.0)[:, None]
        control = turn * place + 0.1 * random.normal(size=place.shape)
        rows.append(({"place": place, "turn": turn}, control))
    return numbered(rows)


DATA = {
    "observations": ["place", "turn"],
    "control": {"std": 0.5},
    "hierarchy": {
        "levels": [{"count": 2, "policy": {"network": "linear"}, "termination": {"network": "linear"}}],
        "meta_policy": {"network": "linear"},
    },
    "training": {"starts": ["vq"], "epochs": 8, "batch_size": 6, "optimizer": {"lr": 0.05}},
    "selection": {"folds": 4, "grid": {"hierarchy.levels.0.count": [1, 2]}},
}


def data_at(folder, demos=None):
    """The spec's data, for demonstrations that are written into the folder."""
    path = folder / "demos.hdf5"
    (demos or two_skills()).write(path)
    return {**DATA, "demonstrations": {"path": str(path)}}


def spec_at(folder, demos=None, **selection):
    """The spec of a selection."""
    data = data_at(folder, demos)
    return parse_spec({**data, "selection": {**data["selection"], **selection}})


def scored(candidate, fold, per_step, lengths=(10,)):
    """By candidate and fold, the metrics of a fit that says ``per_step`` nats in each demonstration."""
    known = {f"demo_{n}": own for n, own in enumerate(lengths)}
    rows = [{"name": n, "steps": own, "log_likelihood": per_step * own} for n, own in known.items()]
    return {(candidate, fold): made_metrics(valid=rows)}


def kept(folder):
    """The metrics in a selection's folder, by candidate and fold."""
    paths = sorted((folder / "folds").iterdir())
    return {tuple(map(int, path.name.split("-"))): Metrics.read(path, [counts(path)]) for path in paths}


def counts(folder):
    """The number of options of a run."""
    return load_spec(folder / "spec.yaml").hierarchy.levels[0].count


SPEC = parse_spec({**DATA, "demonstrations": {"path": "demos.hdf5"}})


def candidate(number, parameters=None, spec=SPEC):
    values = {"hierarchy.levels.0.count": number + 1}
    return Candidate(number, values, spec, 10 * (number + 1) if parameters is None else parameters)
