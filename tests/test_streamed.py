"""What comes after a fit says the same of pictures in their file and of pictures in memory, bit for bit.

Fits themselves are compared in ``test_pictures.py``; rollouts see no stored picture.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from command_line import call

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.pictures import Pictures
from ddco_pyro.selection import Workers, select
from ddco_pyro.spec import parse_spec

CONV = {"network": "conv", "filters": 3, "kernel": 3, "pooled": 2, "hidden": [5]}
LINEAR = {"network": "linear", "inputs": ["pose"]}
LEVEL = "skill"


class Both(NamedTuple):
    """A file of demonstrations, the same ones in memory, and a fit to each."""

    path: Path
    memory: Demonstrations
    streamed: ddco_pyro.Fit
    whole: ddco_pyro.Fit


def spec_of(path: Path, **more: Any) -> dict[str, Any]:
    return {
        "demonstrations": {"path": str(path), "valid_fraction": 0.25, "labels": "phase"},
        "observations": ["pose", {"key": "camera", "crop": [1, 2, 10, 8], "resize": [5, 4], "augment": {"shift": 1}}],
        "hierarchy": {
            "levels": [{"name": LEVEL, "count": 2, "policy": CONV, "termination": LINEAR}],
            "meta_policy": LINEAR,
        },
        "training": {"epochs": 3, "batch_size": 3, "patience": None},
        **more,
    }


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Both:
    folder, random = tmp_path_factory.mktemp("streamed"), np.random.default_rng(0)

    def one(number: int) -> Demonstration:
        steps = 6 + number
        camera = random.integers(0, 256, (steps, 12, 10, 3), dtype=np.uint8)
        seen = {"pose": random.normal(size=(steps, 3)), "camera": camera}
        return Demonstration(f"demo_{number}", seen, random.normal(size=(steps, 2)), {"phase": np.arange(steps) // 4})

    memory = Demonstrations(tuple(one(number) for number in range(8)))
    memory.write(folder / "demos.hdf5")
    spec = parse_spec(spec_of(folder / "demos.hdf5", compare_with=[{"kind": "flat", "policy": CONV}]))
    fits = ddco_pyro.fit(spec, out=folder / "streamed"), ddco_pyro.fit(spec, memory, folder / "memory")
    return Both(folder / "demos.hdf5", memory, *fits)


def test_what_is_said_of_demonstrations(both: Both) -> None:
    """Likelihoods, posteriors and segments, by the fit and by what is loaded from its folder."""
    stored = Demonstrations.read(both.path)
    assert isinstance(stored[0].observations["camera"], Pictures)
    for fit in (both.streamed, ddco_pyro.load(both.streamed.run_folder)):
        np.testing.assert_array_equal(fit.log_likelihood(stored), both.whole.log_likelihood(both.memory))
        for kind, expected in zip(fit.posterior(stored), both.whole.posterior(both.memory), strict=True):
            for level, one in zip(kind, expected, strict=True):
                np.testing.assert_array_equal(level, one)
        np.testing.assert_array_equal(fit.segment(stored)[0], both.whole.segment(both.memory)[0])


def test_segments_of_a_file(both: Both, tmp_path: Path) -> None:
    ended = call("segment", both.streamed.folder, both.path, "--out", tmp_path / "labelled.hdf5")
    assert ended.status == 0, ended.err
    expected = both.whole.segment(both.memory)[0]
    with h5py.File(tmp_path / "labelled.hdf5") as file:
        for name, row in zip(both.memory.names, expected, strict=True):
            np.testing.assert_array_equal(file[f"data/{name}/labels/{LEVEL}"], row[row >= 0])


def test_a_monitor_and_a_controller(both: Both) -> None:
    """Given the pictures of a file one by one."""
    stored = Demonstrations.read(both.path)[2].observations
    monitors = both.streamed.monitor(), both.whole.monitor()
    controllers = both.streamed.controller(seed=1), both.whole.controller(seed=1)
    control = None
    for step in range(len(stored["pose"])):
        seen = [{key: values[step] for key, values in each.items()} for each in (stored, both.memory[2].observations)]
        beliefs = [monitor.step(one, control) for monitor, one in zip(monitors, seen, strict=True)]
        np.testing.assert_equal(*([level.numpy() for level in belief[0]] for belief in beliefs))
        acted = [controller.act(one) for controller, one in zip(controllers, seen, strict=True)]
        np.testing.assert_array_equal(*acted)
        control = acted[0]
    assert monitors[0].log_likelihood == monitors[1].log_likelihood != 0


@pytest.mark.slow
def test_a_selection(both: Both, tmp_path: Path) -> None:
    """Every fold of every candidate has the same score, in a process of its own too."""
    data = spec_of(both.path, selection={"folds": 2, "grid": {"hierarchy.levels.0.count": [1, 2]}})
    spec = parse_spec(data | {"demonstrations": {"path": str(both.path)}})
    select(spec, tmp_path / "streamed", workers=Workers(2))
    select(spec, tmp_path / "memory", workers=Workers(1), demos=both.memory)
    files = sorted((tmp_path / "streamed" / "folds").glob("*.json"))
    assert len(files) == 4
    for file in files:
        scores = [json.loads((tmp_path / name / "folds" / file.name).read_text()) for name in ("streamed", "memory")]
        assert scores[0] | {"seconds": ...} == scores[1] | {"seconds": ...}
