"""Pictures, labels and controls are read by their type and layout, alike from files and from memory."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from odd_files.kinds import NUMBER, ROWS, arrays

from ddco_pyro.data.controls import number
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.pictures import channels_last, turned


def stored(path: Path, key: str) -> list[np.ndarray]:
    with h5py.File(path) as file:
        return [file[f"data/demo_{index}/obs/{key}"][()] for index in range(NUMBER)]


@pytest.mark.parametrize("name", ["channels first", "grey"])
@pytest.mark.parametrize("block", [1, 10**9])
def test_pictures_are_turned_when_they_are_read(
    name: str, block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ddco_pyro.data.pictures.BLOCK_BYTES", block)
    path = ROWS[name].make(tmp_path)
    each = stored(path, "camera")
    expected = [frames[..., None] if name == "grey" else frames.transpose(0, 2, 3, 1) for frames in each]
    read = Demonstrations.read(path)
    for demo, frames in zip(read, expected, strict=True):
        camera = demo.observations["camera"]
        np.testing.assert_array_equal(np.asarray(camera), frames)
        np.testing.assert_array_equal(camera[1:4], frames[1:4])
        np.testing.assert_array_equal(camera[-1], frames[-1])
    assert inspect(path).fields["obs/camera"].shape == read.observation_shapes["camera"] == expected[0].shape[1:]
    import_demonstrations(path, tmp_path / "imported.hdf5")
    for frames, imported in zip(expected, stored(tmp_path / "imported.hdf5", "camera"), strict=True):
        np.testing.assert_array_equal(imported, frames)
    made = [demo_of(arrays(index) | {"obs/camera": frames}) for index, frames in enumerate(each)]
    for demo, frames in zip(made, expected, strict=True):
        np.testing.assert_array_equal(demo.observations["camera"], frames)


def demo_of(made: dict[str, np.ndarray], **labels: np.ndarray) -> Demonstration:
    seen = {place.removeprefix("obs/"): values for place, values in made.items() if place.startswith("obs/")}
    return Demonstration("demo_0", seen, made["actions"], labels)


@pytest.mark.parametrize(
    ("shape", "dtype", "expected"),
    [
        ((9, 3, 12, 10), "u1", (9, 12, 10, 3)),
        ((9, 12, 10, 3), "u1", (9, 12, 10, 3)),
        ((9, 4, 12, 10), "u1", (9, 12, 10, 4)),
        ((9, 2, 12, 10), "u1", (9, 2, 12, 10)),  # no picture has two channels
        ((9, 3, 4, 4), "u1", (9, 3, 4, 4)),  # three rows of four pixels of four channels, as well
        ((9, 12, 10), "u1", (9, 12, 10, 1)),
        ((9, 12, 10), "u2", (9, 12, 10, 1)),
        ((9, 12, 10), "f4", (9, 12, 10)),  # versions of a vector
        ((9, 3, 12, 10), "f4", (9, 3, 12, 10)),
        ((9, 12, 3), "u1", (9, 12, 3)),
        ((9, 12), "u1", (9, 12)),
        ((9,), "u1", (9,)),
    ],
)
def test_which_arrays_are_turned(shape: tuple[int, ...], dtype: str, expected: tuple[int, ...]) -> None:
    assert channels_last(shape, np.dtype(dtype)) == expected
    again = turned(turned(np.zeros(shape, dtype)))
    assert again.shape == expected


def test_labels_of_a_column_and_discrete_actions_need_no_column(tmp_path: Path) -> None:
    phase = np.array([1, 1, 2, -1])
    made = {"actions": np.array([3, 0, 1, 1]), "obs/pose": np.zeros((4, 2))}
    demo = demo_of(made, phase=phase[:, None])
    np.testing.assert_array_equal(demo.labels["phase"], phase)
    np.testing.assert_array_equal(demo.actions, made["actions"][:, None])
    assert (demo.labels["phase"].dtype, demo.actions.dtype) == (np.int64, np.int64)
    for broken in (phase[:, None].astype(float), np.tile(phase[:, None], 2), phase.astype(str)):
        with pytest.raises(DemonstrationsError, match=r"demo_0: labels/phase (is|holds) "):
            demo_of(made, phase=broken)
    for broken in (made["actions"] > 0, made["actions"].astype(np.float32)):
        with pytest.raises(DemonstrationsError, match=r"demo_0: actions is (bool|float32) of shape \[steps\]; store"):
            demo_of({**made, "actions": broken})


def test_what_is_written_again_has_labels_and_the_type_of_its_controls(tmp_path: Path) -> None:
    path = ROWS["labels of a column"].make(tmp_path)
    Demonstrations.read(path).write(tmp_path / "again.hdf5")
    before, after = Demonstrations.read(path), Demonstrations.read(tmp_path / "again.hdf5")
    assert {"phase"} == before[0].labels.keys() == after[0].labels.keys()
    np.testing.assert_array_equal(after[2].labels["phase"], before[2].labels["phase"])
    assert Demonstrations.read(path, labels=())[0].labels == {}
    (tmp_path / "whole").mkdir()
    Demonstrations.read(ROWS["integers [T]"].make(tmp_path / "whole")).write(tmp_path / "again.hdf5")
    assert inspect(tmp_path / "again.hdf5").fields["actions"].dtype == "int64"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (-0.9999999, "-0.9999999"),
        (float(np.float32(0.1)), "0.1"),
        (0.1, "0.1"),
        (-0.0, "0"),
        (123456789.0, "123456789"),
        (1.0000001e30, "1.0000001e+30"),
        (1e300, "1e+300"),
        (float("nan"), "nan"),
    ],
)
def test_a_value_is_printed_as_it_is(value: float, text: str) -> None:
    assert number(value) == text
