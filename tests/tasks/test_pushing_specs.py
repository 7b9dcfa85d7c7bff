"""Every spec of the pushing task can be checked and fitted, and its policy acts in the task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ddco_tasks.pushing import environment as pushing

from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.fitting.fit import fit
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import dimensions
from ddco_pyro.training.networks import check_networks

SPECS = sorted((Path(__file__).parents[2] / "specs").glob("pushing*.yaml"))
LEVELS = {
    "flat_linear": 0, "flat_mlp": 0, "linear": 1, "mlp": 1, "hybrid": 1, "3level": 2, "image_ff": 1, "image_ff_flat": 0,
    "image_ff_hybrid": 1, "image_rnn": 1, "image_rnn_flat": 0, "image_rnn_hybrid": 1,
}  # fmt: skip
CAMERAS = {"camera": pushing.camera(48, 64)}
QUICK = ("pushing_3level", "pushing_hybrid", "pushing_flat_mlp")


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with four demonstrations."""
    path = tmp_path_factory.mktemp("pushing") / "demonstrations.hdf5"
    single = replace(pushing.single, cameras=CAMERAS)
    episodes = [run_episode(single, "scripted_noisy", seed, observed=CAMERAS) for seed in range(4)]
    Demonstrations(tuple(one.record for one in episodes)).write(path)
    return path


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[] if path.stem in QUICK else pytest.mark.slow) for path in SPECS],
    ids=lambda path: path.stem,
)
def test_specs_fit_and_act(path: Path, demonstrations: Path, tmp_path: Path) -> None:
    short = load_spec(path, [f"demonstrations.path={demonstrations}", "training.epochs=6"])
    found = fit(short, out=tmp_path / "run")
    assert found.metrics.engine_check.value < 1e-6
    brief = replace(pushing.limited, load=lambda seed: pushing.load_single(seed), cameras=CAMERAS)
    controller = Controller(found.hierarchy, found.spec.rollout.control, found.spec.rollout.options)
    episode = run_episode(brief, controller, 0, observed=found.spec.observed, keep=("tip",))
    levels = LEVELS[path.stem.removeprefix("pushing_")]
    assert episode.choices.shape == (len(episode.record.observations["tip"]), levels)
    lowest = 0 if path.stem.endswith("hybrid") else 1
    assert not levels or episode.choices.min() >= lowest
    assert np.ptp(episode.record.observations["tip"], axis=0).max() > 1e-3  # the arm moves


@pytest.mark.parametrize("path", SPECS, ids=lambda path: path.stem)
def test_specs_are_checked_against_the_task(path: Path) -> None:
    spec = load_spec(path)
    known = dimensions(spec)
    assert (known.control_size, known.steps) == (3, pushing.GOAL_STEPS)
    assert check_networks(spec, known).depth == LEVELS[path.stem.removeprefix("pushing_")]
