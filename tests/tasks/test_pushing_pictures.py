"""Pictures of the pushing task say what the control depends on, and a file with them says it nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ddco_tasks.pushing import environment as pushing

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import Spec, parse_spec

CAMERAS = {"camera": pushing.camera(48, 64)}
CONVOLUTION = {
    "network": "conv",
    "layers": [{"filters": 8, "kernel": 5, "stride": 4, "padding": 2}],
    "pool": "spatial_softmax",
    "hidden": [32],
}
TRAINED, HELD_OUT = 16, 8


def spec() -> Spec:
    """Behaviour cloning from pictures, standardised controls, σ = 1."""
    return parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5"},
            "observations": [{"key": "camera", "frames": 2}],
            "control": {"std": 1.0},
            "baseline": {"kind": "flat", "policy": CONVOLUTION},
            "training": {"epochs": 40, "patience": None, "batch_size": 2, "optimizer": {"lr": 0.005}},
        }
    )


def explained(demos: Demonstrations) -> float:
    """The share of the held-out controls' variance that a policy trained on the others explains, from likelihoods."""
    fit = ddco_pyro.fit(spec(), demos)
    held_out = demos.select(demos.masks["valid"])
    controls = np.concatenate([demo.actions for demo in held_out])
    scale = fit.hierarchy.scaling
    spread = np.square((controls - controls.mean(0)) / scale.scale.numpy()).mean(0).sum()
    logs = np.log(2 * np.pi * np.square(scale.scale.numpy())).sum()
    squared = -2 * float(fit.log_likelihood(held_out).sum()) / len(controls) - logs
    return 1 - squared / spread


@pytest.mark.slow
def test_pictures_tell_the_control_and_shuffled_ones_do_not() -> None:
    """Shuffled over all steps of all demonstrations, so that all else stays in its place."""
    single = replace(pushing.single, cameras=CAMERAS)
    records = [
        run_episode(single, "scripted_noisy_0.3", 700_000 + seed, observed=CAMERAS, keep=CAMERAS).record
        for seed in range(TRAINED + HELD_OUT)
    ]
    names = [record.name for record in records]
    masks = {"train": tuple(names[:TRAINED]), "valid": tuple(names[TRAINED:])}
    pictures = np.concatenate([record.observations["camera"] for record in records])
    order, ends = np.random.default_rng(0).permutation(len(pictures)), np.cumsum([len(record) for record in records])
    shuffled = [
        replace(record, observations={"camera": part})
        for record, part in zip(records, np.split(pictures[order], ends[:-1]), strict=True)
    ]
    assert explained(Demonstrations(tuple(records), masks)) > 0.3
    assert explained(Demonstrations(tuple(shuffled), masks)) < 0.05
