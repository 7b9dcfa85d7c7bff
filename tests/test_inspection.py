"""What ``inspect`` says of a file, against what was put into it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import call
from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.data.inspection import inspect


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "demos.hdf5"
    demonstrations(5, {"valid": ("demo_1",), "20_percent": ("demo_0",)}).write(found)
    with h5py.File(found, "r+") as file:
        for name, group in file["data"].items():
            steps = len(group["actions"])
            group["obs/goal"] = np.tile(float(name[-1]), (steps, 2))
            group["obs/fixed"] = np.full((steps, 3), [1.0, 2.0, 3.0], dtype=np.float32)
            group["actions"][:, 1] = 0.5
        file["data"].attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
    return found


def test_shapes_ranges_lengths_and_constants(path: Path) -> None:
    found = inspect(path)
    original = demonstrations(5)
    assert found.format == "robomimic"
    assert found.lengths == dict(zip(original.names, original.lengths, strict=True))
    assert found.frequency == 20
    assert found.masks == {"valid": ("demo_1",), "20_percent": ("demo_0",)}
    assert found.problems == []
    pose = np.concatenate([demo.observations["pose"] for demo in original])
    np.testing.assert_array_equal(found.fields["obs/pose"].minimum, pose.min(0))
    np.testing.assert_array_equal(found.fields["obs/pose"].maximum, pose.max(0))
    assert found.fields["actions"].constant == [1]
    assert found.fields["obs/fixed"].constant == [0, 1, 2]
    assert found.fields["obs/fixed"].dtype == "float32"
    assert [one.key for one in found.observations if one.still] == ["fixed", "goal"]
    assert [one.key for one in found.observations if one.image] == ["camera"]
    assert [one.key for one in found.labels] == ["phase"]


@pytest.mark.parametrize("block", [1, 10**9])
def test_blocks_do_not_matter(path: Path, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = inspect(path).as_json()
    monkeypatch.setattr("ddco_pyro.data.pictures.BLOCK_BYTES", block)
    assert inspect(path).as_json() == whole


def test_what_a_fit_would_refuse_is_said(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data/demo_1/obs/pose"][2, 1] = np.nan
        file["data/demo_2/obs/pose"][0, 0] = np.inf
        del file["data/demo_3/obs/goal"]
        file["data/demo_3/obs/goal"] = np.ones((2, 2))
        del file["data/demo_4/actions"]
        del file["mask/valid"]
        file["mask/valid"] = [b"demo_9"]
    found = inspect(path)
    assert (found.fields["obs/pose"].nan, found.fields["obs/pose"].infinite) == (1, 1)
    assert np.isfinite(found.fields["obs/pose"].minimum).all()
    assert found.problems == [
        "demo_3: obs/goal has 2 steps, but actions has 6",
        "demo_4: actions is missing; there is: labels/phase, obs/camera, obs/fixed, obs/goal, obs/pose",
        "mask/valid: there is no demonstration 'demo_9' (did you mean 'demo_4'?)",
        "obs/pose has 1 NaN and 1 infinite values, the first in demo_1 at step 2; 2 of 4 demonstrations are affected",
    ]


@pytest.mark.parametrize("block", [1, 10**9])
def test_values_that_cannot_be_used_have_a_place(path: Path, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the blocks; and a number that no network takes is one of them."""
    monkeypatch.setattr("ddco_pyro.data.pictures.BLOCK_BYTES", block)
    with h5py.File(path, "r+") as file:
        file["data/demo_3/obs/pose"][[2, 4], 1] = np.nan, 1e300
        file["data/demo_4/obs/pose"][:, 2] = -2e30
        file["data/demo_4/obs/goal"][2] = np.inf
        file["data/demo_3/labels/phase"][0] = 2**40
    found = inspect(path)
    pose, goal = found.fields["obs/pose"], found.fields["obs/goal"]
    assert (pose.nan, pose.infinite, pose.huge) == (1, 0, 1 + 3)
    assert (pose.first, pose.affected) == (("demo_3", 2), ["demo_3", "demo_4"])
    assert (goal.first, goal.affected) == (("demo_4", 2), ["demo_4"])
    assert found.affected == ["demo_3", "demo_4"]
    assert found.problems == [
        "obs/goal has 0 NaN and 2 infinite values, the first in demo_4 at step 2; 1 of 5 demonstrations is affected",
        "obs/pose has 1 NaN and 0 infinite values and 4 beyond ±1e+30, the first in demo_3 at step 2; 2 of 5 "
        "demonstrations are affected",
    ]
    assert "1 NaN, 0 infinite; 4 beyond ±1e+30" in call("inspect", path).out
    assert inspect(path, exclude=["demo_3", "demo_4"]).problems == []


def test_what_reading_refuses_is_a_problem_and_is_not_imported(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data/demo_1"].attrs["num_samples"] = 9
        steps = len(file["data/demo_2/actions"])
        del file["data/demo_2/obs/goal"]
        file["data/demo_2/obs/goal"] = np.ones((steps, 7))
    short = "demo_1: actions has 4 steps, but num_samples is 9"
    other = "demo_2: obs/goal has shape (7,) at each step, but (2,) in"
    first, second, *_ = inspect(path).problems
    assert (first, second[: len(other)]) == (short, other)
    for exclude, message in (((), short), (("demo_1",), other)):
        with pytest.raises(DemonstrationsError, match=re.escape(message)):
            Demonstrations.read(path, exclude=exclude)
    ended = call("import", path, "--out", tmp_path / "out.hdf5", "--skip-broken")
    assert (ended.out, ended.err.count("left out")) == (f"{tmp_path / 'out.hdf5'}: 3 demonstrations\n", 2)


def test_demonstrations_that_are_left_out_do_not_count(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data/demo_1/actions"][:, 1] = 7
    found, rest = inspect(path), inspect(path, exclude=["demo_1"])
    assert found.notes[0] == "control dimension 1: takes two values, 0.5 and 7"
    assert rest.notes[0] == "control dimension 1: constant (0.5): no part of the model, emitted as it is"
    assert found.notes[-1] == "control dimension 1: binary (takes two values, 0.5 and 7), by control.kind: auto"
    assert not any("dimension 1: binary" in note for note in rest.notes)
    assert list(rest.lengths) == ["demo_0", "demo_2", "demo_3", "demo_4"]
    assert rest.masks == {"valid": (), "20_percent": ("demo_0",)}


def test_a_place_that_holds_nothing_known_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DemonstrationsError, match="there is no such file or folder; check the path"):
        inspect(tmp_path / "none")
    with pytest.raises(DemonstrationsError, match="is a folder of no known format; name an HDF5 file"):
        inspect(tmp_path)


def test_the_command_shows_it_and_a_spec(path: Path) -> None:
    ended = call("inspect", path)
    assert (ended.status, ended.err) == (0, "")
    assert "robomimic, 5 demonstrations of 3 to 6 steps (median 4, 21 in all)" in ended.out
    assert "control frequency: 20 Hz" in ended.out
    rows = {line.split("│")[0].strip(): [c.strip() for c in line.split("│")[1:]] for line in ended.out.splitlines()}
    assert rows["obs/fixed"] == ["[3]", "float32", "1 to 3", "constant"]
    assert rows["actions"][-1] == "constant: 1"
    assert "observations:" in ended.out
    whole = json.loads(call("inspect", path, "--json").out)
    assert whole == json.loads(json.dumps(inspect(path).as_json()))


def test_markup_in_names_is_shown_as_it_is(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            group["obs/[red]x[/red]"] = np.ones((len(group["actions"]), 1))
    assert "obs/[red]x[/red]" in call("inspect", path).out
