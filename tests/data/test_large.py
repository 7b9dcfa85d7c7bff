"""Files that are larger than memory: streamed where that can be, else refused before they are read."""

from __future__ import annotations

import math
from pathlib import Path

import h5py
import numpy as np
import pytest
import toy_task
import yaml
from command_line import call
from large import measured, zeros
from random_demonstrations import demonstrations as random_demonstrations

from ddco_pyro.data.demonstrations import DemonstrationsError
from ddco_pyro.data.memory import PROGRAM, allowed
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import parse_spec
from ddco_pyro.training.data import demonstrations

GIGABYTE = 10**9
LIMIT = 2 * GIGABYTE


@pytest.fixture(autouse=True)
def two_gigabytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is allowed does not depend on the machine that runs the tests."""
    monkeypatch.setenv("DDCO_PYRO_MEMORY", "2GB")


def large(path: Path, number: int, steps: int, size: int = 1000) -> Path:
    """Demonstrations of as many numbers, all zero, compressed; controls that are not."""
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(number):
            group = file.create_group(f"data/demo_{index}")
            zeros(group, "obs/state", (steps, size), (min(steps, 1000), size))
            group["obs/arm"] = random.normal(size=(steps, 2))
            group["actions"] = random.normal(size=(steps, 2))
    return path


def spec_of(path: Path, *observations: str) -> Path:
    spec = path.with_suffix(".yaml")
    data = yaml.safe_load(toy_task.SPEC)
    del data["task"], data["rollout"], data["compare_with"]
    data |= {"demonstrations": {"path": str(path)}, "observations": list(observations)}
    spec.write_text(yaml.safe_dump(data))
    return spec


# --- before anything is read ------------------------------------------------------------------------------------------


def test_a_fit_to_what_is_larger_than_memory_is_refused(tmp_path: Path) -> None:
    """8 GB in a file of a few megabytes: 28 bytes for each observation and control of a step, and the program."""
    eight = large(tmp_path / "eight.hdf5", 10, 100_000)
    spec, size = spec_of(eight, "state"), f"{math.ceil((28 * 10**6 * (1000 + 2) + PROGRAM) / 1e8) / 10:g}"
    for command in (["check", spec], ["fit", spec, "--out", tmp_path / "run"], ["select", spec, "--out", tmp_path]):
        ended = call(*command)
        assert (ended.status, ended.err.count("\n")) == (2, 1)
        assert ended.err.startswith(
            f"ddco-pyro: {eight}: a fit to state takes about {size} GB of memory, and 2 are allowed;"
        )
        assert "leave observations out" in ended.err
        assert ended.err.endswith(f"or allow more with DDCO_PYRO_MEMORY={size}GB\n")
    assert not (tmp_path / "run").exists()
    assert call("check", spec_of(eight, "arm")).status == 0  # what is not asked for does not count


def test_more_can_be_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "demos.hdf5"
    random_demonstrations(4).write(path)
    spec = parse_spec(yaml.safe_load(spec_of(path, "pose").read_text()))
    assert demonstrations(spec).names == ("demo_0", "demo_1", "demo_2", "demo_3")
    monkeypatch.setenv("DDCO_PYRO_MEMORY", "0.5GB")
    with pytest.raises(DemonstrationsError, match=r"and 0\.5 are allowed"):
        demonstrations(spec)
    for wrong in ("much", "-1", "0", "nan", "2 apples", "1e999"):
        monkeypatch.setenv("DDCO_PYRO_MEMORY", wrong)
        with pytest.raises(BadInput, match=rf"DDCO_PYRO_MEMORY={wrong}: has to be a number of GB, or one with a unit"):
            allowed()
    for said, meant in (("16", 16e9), ("2GB", 2e9), ("0.5 gb", 5e8), ("700MB", 7e8)):
        monkeypatch.setenv("DDCO_PYRO_MEMORY", said)
        assert allowed() == meant


@pytest.mark.slow
def test_a_fit_to_pictures_stays_within_what_is_allowed(tmp_path: Path) -> None:
    """290 MB of pictures; what they take on the way through networks is a multiple of that."""
    path, spec, random = tmp_path / "demos.hdf5", tmp_path / "spec.yaml", np.random.default_rng(0)
    noise = random.integers(0, 256, (420, 240, 320, 3), dtype=np.uint8)
    with h5py.File(path, "w") as file:
        for index in range(3):
            file[f"data/demo_{index}/obs/seen"] = noise
            file[f"data/demo_{index}/actions"] = random.normal(size=(420, 3))
    data = {
        "demonstrations": {"path": str(path), "valid_fraction": 0.2},
        "observations": ["seen"],
        "baseline": {
            "kind": "flat",
            "policy": {
                "network": "conv",
                "layers": [{"filters": 4, "kernel": 5, "stride": 2, "padding": 2}],
                "hidden": [8],
            },
        },
        "training": {"epochs": 1},
    }
    spec.write_text(yaml.safe_dump(data))
    ended = measured("fit", spec, "--out", tmp_path / "run", DDCO_PYRO_MEMORY="850MB")
    print(f"{path.stat().st_size / 1e6:.0f} MB of pictures: {ended.peak / 1e6:.0f} MB at most")
    assert ended.status == 0, ended.err
    assert ended.peak < 850e6


def test_a_demonstration_that_cannot_be_segmented_is_refused(toy_run, tmp_path: Path) -> None:
    """What the toy run was fitted to, much of it."""
    path, steps = tmp_path / "long.hdf5", 10**6
    with h5py.File(path, "w") as file:
        for name in ("demo_0", "demo_1"):
            for key, size in (("obs/offsets", 4), ("obs/visited", 1), ("actions", 2)):
                zeros(file, f"data/{name}/{key}", (steps, size), (steps, size))
    ended = call("segment", toy_run.folder, path, "--in-place")
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert ended.err.startswith(f"ddco-pyro: {path}: demo_0: segmenting its 1000000 steps takes about")
    assert "divide it" in ended.err


# --- what is streamed -------------------------------------------------------------------------------------------------


def test_looking_does_not_take_more_than_a_block(tmp_path: Path) -> None:
    small, path = large(tmp_path / "small.hdf5", 3, 100), large(tmp_path / "large.hdf5", 3, 10_000)
    base, found = measured("inspect", small), measured("inspect", path)
    assert (base.status, found.status) == (0, 0)
    assert "3 demonstrations of 10000 to 10000 steps" in found.out
    assert found.peak - base.peak < 150e6  # of 240 MB


@pytest.mark.slow
def test_a_file_that_really_has_more_than_memory(tmp_path: Path, toy_run, toy_spec) -> None:
    """2.6 GB of noise for pictures, which no network sees: all goes through, and is right."""
    path, number, steps = tmp_path / "demos.hdf5", 26, 500
    originals = list(demonstrations(toy_spec))
    random = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for index in range(number):
            group = file.create_group(f"data/demo_{index}")
            one = originals[index % len(originals)]
            rows = np.resize(np.arange(len(one)), steps)
            for key in ("offsets", "visited"):
                group[f"obs/{key}"] = one.observations[key][rows]
            group["actions"] = one.actions[rows]
            group.create_dataset("obs/camera", data=random.integers(0, 256, (steps, 250, 267, 3), dtype=np.uint8))
    assert path.stat().st_size > 2.6 * GIGABYTE
    peaks = {}

    def run(*arguments: object) -> str:
        ended = measured(*arguments)
        assert ended.status == 0, ended.err
        peaks[arguments[0]] = ended.peak
        return ended.out

    assert "26 demonstrations of 500 to 500 steps" in run("inspect", path)
    run("init", path, "--out", tmp_path / "spec.yaml")
    run("fit", tmp_path / "spec.yaml", "--out", tmp_path / "run", "--set", "training.epochs=2")
    run("segment", toy_run.folder, path, "--in-place", "--html", tmp_path / "a.html")
    run("import", path, "--out", tmp_path / "imported.hdf5")
    print({name: f"{peak / 1e6:.0f} MB" for name, peak in peaks.items()})
    assert max(peaks.values()) < LIMIT
    with h5py.File(path) as file, h5py.File(tmp_path / "imported.hdf5") as imported:
        for name in ("demo_0", "demo_25"):
            for key in ("actions", "obs/camera", "labels/option"):
                np.testing.assert_array_equal(imported[f"data/{name}/{key}"], file[f"data/{name}/{key}"])
