"""Episodes played together against the same episodes of a controller played alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import toy_task

from ddco_pyro.acting.controller import Controller
from ddco_pyro.model.hierarchy import Hierarchy
from ddco_pyro.simulation.episodes import play, run_episode
from ddco_pyro.spec import RolloutSpec, parse_spec

SEEDS = (3, 4, 5, 6)
MEAN = RolloutSpec(control="mean", options="most_likely")
MARGINAL = RolloutSpec(control="mean", options="marginal")
SAMPLED = RolloutSpec(control="sample", options="sample")
SHAPES = {"offsets": (4,), "visited": (1,)}
OBSERVATIONS = [{"key": "offsets", "differences": True}, "visited"]


def make(model, weights=0, gain=1.0):
    """A model of the toy task whose networks see differences, its weights drawn from this seed and that much larger."""
    spec = parse_spec({"demonstrations": {"path": "unused.hdf5"}, "observations": OBSERVATIONS, **model})
    torch.manual_seed(weights)
    hierarchy = Hierarchy(spec, SHAPES, 2, steps=toy_task.STEPS)
    with torch.no_grad():
        for parameter in hierarchy.parameters():
            parameter.mul_(gain)
    return hierarchy


def two_levels(emits):
    """Two option levels whose callers all emit ``emits``."""
    levels = [{"name": "low", "count": 3}, {"name": "high", "count": 2, "policy": {"emits": emits}}]
    return {"hierarchy": {"levels": levels, "meta_policy": {"emits": emits}}}


MODELS = {
    "flat": {"baseline": "flat"},
    "options": two_levels(["options"]),
    "hybrid": two_levels(["options", "control"]),
    "lstm": {"observations": [*OBSERVATIONS, "step"], "baseline": {"kind": "flat", "policy": {"network": "lstm"}}},
    "windows": {
        "observations": OBSERVATIONS,
        "baseline": {"kind": "flat", "policy": {"network": "lstm", "horizon": 2}},
    },
}


def ragged(task):
    """The task with episodes of different lengths."""
    return replace(task, load=lambda seed: toy_task.Point(seed, steps=seed))


@pytest.mark.parametrize("spec", [MEAN, MARGINAL, SAMPLED], ids=["most likely", "marginal", "sampled"])
@pytest.mark.parametrize(
    ("name", "weights", "actors"),
    [
        *((name, (0,), {0}) for name in ("flat", "lstm", "windows")),
        ("options", (4, 6, 8), {0}),
        ("hybrid", (0, 2, 10), {0, 1, 2}),
    ],
)
def test_together_as_alone(name, weights, actors, spec):
    """With models in which options change within an episode and, in the hybrid, an option of each level and the
    meta-policy act.
    """
    task, acted, changes = ragged(toy_task.task), set(), 0
    for seed in weights:
        hierarchy = make(MODELS[name], seed, gain=3.0)
        for found in play(task, Controller.from_spec(hierarchy, spec), SEEDS, keep=("offsets",)):
            alone = run_episode(task, Controller.from_spec(hierarchy, spec), found.seed)
            assert found.outcome == pytest.approx(alone.outcome, abs=1e-5, nan_ok=True)
            np.testing.assert_array_equal(found.choices, alone.choices)
            np.testing.assert_allclose(
                found.record.observations["offsets"], alone.record.observations["offsets"], atol=1e-5
            )
            acted |= {next((d for d, choice in enumerate(row) if choice), len(row)) for row in found.choices.tolist()}
            changes += (np.diff(found.choices, axis=0) != 0).any(1).sum()
    assert acted == actors
    assert changes > 1 or name in ("flat", "lstm", "windows")


def test_environments_are_closed_when_one_fails():
    made = []

    def load(seed):
        made.append(toy_task.Point(seed))
        return made[-1]

    broken = replace(toy_task.task, load=load, outcome=lambda environment: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        play(broken, Controller.from_spec(make(MODELS["flat"]), MEAN), SEEDS)
    assert [one.closed for one in made] == [True] * len(SEEDS)
