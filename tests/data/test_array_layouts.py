"""Pictures, labels and controls are read by their type and layout, alike from files and from memory."""

import contextlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import call
from odd_files.kinds import NUMBER, ROWS, arrays, put, write
from odd_files.kinds import alone as by_itself
from planted import small_spec

import ddco_pyro
from ddco_pyro.data.arrays import network_input, turned
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.errors import BadInput
from ddco_pyro.spec import dump_spec


def stored(path: Path, key: str) -> list[np.ndarray]:
    with h5py.File(path) as file:
        return [file[f"data/demo_{index}/obs/{key}"][()] for index in range(NUMBER)]


@pytest.mark.parametrize("name", ["channels first", "grey"])
def test_pictures_are_turned_when_they_are_read(name: str, tmp_path: Path) -> None:
    path = ROWS[name].make(tmp_path)
    each = stored(path, "camera")
    expected = [frames[..., None] if name == "grey" else frames.transpose(0, 2, 3, 1) for frames in each]
    read = Demonstrations.read(path)
    for demo, frames in zip(read, expected, strict=True):
        camera = demo.observations["camera"]
        np.testing.assert_array_equal(np.asarray(camera), frames)
        np.testing.assert_array_equal(camera[1:4], frames[1:4])
        np.testing.assert_array_equal(camera[-1], frames[-1])
    shape = expected[0].shape[1:]
    assert inspect(path).fields["obs/camera"].shape == read.observation_shapes["camera"] == shape
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
        ((9, 12, 3), "u1", (9, 12, 3)),
        ((9,), "u1", (9,)),
    ],
)
def test_which_arrays_are_turned(shape: tuple[int, ...], dtype: str, expected: tuple[int, ...]) -> None:
    seen = Demonstration("demo_0", {"x": np.zeros(shape, dtype)}, np.zeros((9, 1))).observations["x"]
    assert seen.shape == expected


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
        says = r"demo_0: actions is (bool|float32) of shape \[steps\]; store"
        with pytest.raises(DemonstrationsError, match=says):
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


CONV = {"network": "conv", "layers": [{"filters": 2, "kernel": 1}], "hidden": [4]}


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize(
    ("shape", "dtype", "alone"),
    [
        ((4, 6, 8, 3), "u1", True),
        ((6, 8, 3), "u1", False),
        ((6, 8, 3), "f4", False),
        ((), "O", False),
        ((2,), "c8", False),
        ((0,), "f4", True),
    ],
)
def test_networks_read_an_observation_or_every_command_says_why_not(
    shape: tuple[int, ...], dtype: str, alone: bool, tmp_path: Path
) -> None:
    """Of any shape and type, alone or beside a vector."""
    path, random = tmp_path / "demos.hdf5", np.random.default_rng(0)

    def odd(steps: int, number: int) -> np.ndarray:
        if dtype == "O":
            return np.full((steps, *shape), "pick up the cup", dtype=h5py.string_dtype())
        return random.integers(0, 100, (steps, *shape)).astype(dtype)

    write(path, (by_itself if alone else put)("obs/odd", odd))
    seen = turned(odd(4, 0))
    kind, why = network_input(seen.shape[1:], seen.dtype)
    assert (kind == "") == (why != "")
    assert kind in ("", "vector" if len(seen.shape) < 4 else "picture")
    keys = ["odd"] if alone else ["pose", "odd"]
    policy = CONV if kind == "picture" and alone else {"network": "linear"}
    if kind == "picture" and not alone:
        of = {"odd": CONV, "pose": {"network": "mlp", "hidden": [4]}}
        policy = {"network": "branches", "of": of, "hidden": [4]}
    known, spec, out = {"path": str(path)}, tmp_path / "spec.yaml", tmp_path / "out"
    own = small_spec((), policy, demonstrations=known, observations=keys, training={"epochs": 1})
    spec.write_text(dump_spec(own))
    to = ("--out", out)
    for command in (("inspect", path), ("init", path, *to), ("check", spec), ("import", path, *to)):
        ended = call(*command)
        said = ended.out + ended.err + (out.read_text() if command[0] == "init" and out.exists() else "")
        out.unlink(missing_ok=True)
        assert ended.status in (0, 2), (command, ended)
        assert "Traceback" not in ended.err, (command, ended)
        assert not why or ("odd" in said and (why in said or ended.status == 2)), (command, said)
        assert ended.status == 0 or why, (command, ended)

    with pytest.raises(BadInput, match="odd") if why else contextlib.nullcontext():
        fitted = ddco_pyro.fit(spec)
        assert [*fitted.hierarchy.encoder.shapes] == keys
