"""A small selection for tests: demonstrations of a point, a grid, and scores without any training."""

from __future__ import annotations

import json
from dataclasses import astuple

import numpy as np
from random_demonstrations import numbered

from ddco_pyro.events import CellDone, CellsBegan
from ddco_pyro.selection.folds import Score
from ddco_pyro.selection.grid import Candidate
from ddco_pyro.spec import parse_spec


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
    "control": {"std": 0.5, "scale": "none"},
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


def score(candidate, fold, per_step, lengths=(10,), failed="", steps=0, converged=True):
    """A score that says ``per_step`` nats in each of these demonstrations."""
    names = tuple(f"demo_{fold}_{number}" for number in range(len(lengths)))
    values = () if failed else tuple(per_step * steps for steps in lengths)
    return Score(candidate, fold, names, tuple(lengths), values, failed, steps, converged)


def kept(folder):
    """The scores in a selection's folder, by candidate and fold."""
    found = [json.loads(path.read_text()) for path in sorted((folder / "folds").iterdir())]
    return {(one["candidate"], one["fold"]): one for one in found}


SPEC = parse_spec({**DATA, "demonstrations": {"path": "demos.hdf5"}})


def candidate(number, parameters=None, spec=SPEC):
    values = {"hierarchy.levels.0.count": number + 1}
    return Candidate(number, values, spec, 10 * (number + 1) if parameters is None else parameters)
