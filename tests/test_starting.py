"""The spec that ``init`` writes fits as it is, and leaves out what cannot be fitted."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from gripper import planted
from random_demonstrations import demonstrations
from test_cli import call

import ddco_pyro
from ddco_pyro.demonstrations import DemonstrationsError
from ddco_pyro.inspection import inspect
from ddco_pyro.spec import load_spec
from ddco_pyro.starting import _batch, _epochs, starting_spec


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "my demos: 1.hdf5"
    demonstrations(6).write(found)
    return found


def edit(path: Path, key: str, values: float | None) -> None:
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            if values is not None:
                group[f"obs/{key}"] = np.full((len(group["actions"]), 2), values)


def test_what_it_writes_is_fitted_as_it_is(path: Path, tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    edit(path, "goal", 3.0)
    assert call("init", path, "--out", spec).out == f"{spec}: fit it with: ddco-pyro fit {spec} --out runs/spec\n"
    ended = call("fit", spec, "--out", tmp_path / "run", "--set", "training.epochs=1")
    assert ended.status == 0, ended.err
    assert ended.out.splitlines()[-1] == f"next: ddco-pyro segment {tmp_path / 'run'} '{path}' --html segments.html"
    looked = call("inspect", path).out.splitlines()[-1]
    assert looked == f"next: ddco-pyro init '{path}' --out 'my demos: 1'.yaml"
    fit = ddco_pyro.load(tmp_path / "run")
    assert list(fit.baselines) == ["flat", "flat_equal"]
    assert "agreement" in fit.metrics  # with the labels in the file


@pytest.mark.slow
def test_what_it_writes_lets_every_method_converge(tmp_path: Path) -> None:
    """Two-valued and constant controls are what took longest."""
    planted().write(tmp_path / "gripper.hdf5")
    assert call("init", tmp_path / "gripper.hdf5", "--out", tmp_path / "spec.yaml").status == 0
    ended = call("fit", tmp_path / "spec.yaml", "--out", tmp_path / "run")
    assert ended.status == 0, ended.err
    metrics = ddco_pyro.load(tmp_path / "run").metrics
    trainings = [metrics["training"], *(one["training"] for one in metrics["comparison"].values())]
    assert [one["converged"] for one in trainings] == [True, True, True]
    assert len({json.dumps(one["budget"]) for one in trainings}) == 1


@pytest.mark.parametrize(
    ("lengths", "epochs"),
    [
        ([22] * 120, 2000),  # 3 gradient steps in an epoch: 6000 in all
        ([57] * 100, 1000),  # 6
        ([100] * 1000, 200),  # 100, and 200 epochs at least
        ([10] * 5, 2000),  # 3, in minibatches of 2
    ],
)
def test_epochs_follow_from_the_gradient_steps(lengths: list[int], epochs: int) -> None:
    found = np.array(lengths)
    assert _epochs(found, _batch(found)) == epochs


def test_three_demonstrations_are_enough(tmp_path: Path) -> None:
    demonstrations(3).write(tmp_path / "demos.hdf5")
    assert call("init", tmp_path / "demos.hdf5", "--out", tmp_path / "spec.yaml").status == 0
    ended = call("fit", tmp_path / "spec.yaml", "--out", tmp_path / "run", "--set", "training.epochs=1")
    assert ended.status == 0, ended.err
    numbers = ddco_pyro.load(tmp_path / "run").metrics["demonstrations"]
    assert [numbers[part] for part in ("train", "tune", "valid")] == [1, 1, 1]


def test_it_says_what_it_leaves_out(path: Path, tmp_path: Path) -> None:
    edit(path, "goal", 3.0)
    edit(path, "1e3", np.nan)
    spec = load_spec(write(tmp_path, text := starting_spec(inspect(path), path)))
    assert [(one.key, one.differences) for one in spec.observations] == [("pose", True)]
    assert spec.demonstrations.path == str(path)
    assert "# - goal   # is constant" in text
    assert '# - "1e3"   # has 50 NaN and 0 infinite values' in text
    assert "# - camera   # an image" in text


def test_masks_of_the_file_decide_what_is_held_out(path: Path, tmp_path: Path) -> None:
    assert load_spec(write(tmp_path, starting_spec(inspect(path), path))).demonstrations.valid_fraction == 0.25
    demonstrations(6, {"train": ("demo_0",), "valid": ("demo_1",), "better": ("demo_2",)}).write(path)
    text = starting_spec(inspect(path), path)
    assert "# held out: as mask/train and mask/valid in the file say" in text
    assert "# other masks in the file, not used: better" in text
    assert "valid_fraction" not in text


def test_pictures_alone_are_read_by_convolutions(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            del group["obs/pose"]
    spec = write(tmp_path, starting_spec(inspect(path), path))
    assert yaml.safe_load(spec.read_text())["observations"] == ["camera"]
    assert call("check", spec).status == 0


def write(folder: Path, text: str) -> Path:
    path = folder / "written.yaml"
    path.write_text(text)
    return path


def test_what_cannot_be_fitted_is_refused(path: Path) -> None:
    demonstrations(2).write(path)
    with pytest.raises(DemonstrationsError, match=r"holds 2 demonstrations that can be read, and a fit needs 3"):
        starting_spec(inspect(path), path)
    demonstrations(4).write(path)
    with h5py.File(path, "r+") as file:
        file["data/demo_0/actions"][0] = np.nan
    with pytest.raises(DemonstrationsError, match=r"actions has 2 NaN and 0 infinite values; repair them first"):
        starting_spec(inspect(path), path)
    with h5py.File(path, "r+") as file:
        file["data/demo_0/actions"][0] = 0
        for group in file["data"].values():
            del group["obs/pose"], group["obs/camera"]
            group["obs/text"] = [b"a"] * len(group["actions"])
    with pytest.raises(DemonstrationsError, match=r"no observation can be used; see what is wrong with: ddco-pyro"):
        starting_spec(inspect(path), path)


def test_a_file_that_is_there_is_not_replaced_unasked(path: Path, tmp_path: Path) -> None:
    spec = tmp_path / "spec.yaml"
    spec.write_text("mine")
    ended = call("init", path, "--out", spec)
    assert ended.status == 2
    assert ended.err == f"ddco-pyro: {spec}: is there already; choose another --out, or replace it with --force\n"
    assert call("init", path, "--out", spec, "--force").status == 0
    assert spec.read_text() != "mine"
