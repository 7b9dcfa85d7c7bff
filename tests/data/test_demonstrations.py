"""Demonstrations: what is read is what was written; as a sequence; splits."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odd_files.hdf5 import instead, spoil
from random_demonstrations import demonstration, demonstrations

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError

METAWORLD = Path(__file__).parents[3] / "shared" / "data" / "metaworld_pick_place.hdf5"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "demos.hdf5"


def test_what_is_read_is_what_was_written(path: Path) -> None:
    original = demonstrations(masks={"valid": ("demo_2", "demo_10"), "none": ()})
    original.write(path)
    read = Demonstrations.read(path, labels=["phase"])
    assert read.names == original.names
    assert (read.masks, read.attributes) == (original.masks, original.attributes)
    for one, other in zip(read, original, strict=True):
        assert (one.name, one.attributes) == (other.name, other.attributes)
        np.testing.assert_array_equal(one.actions, other.actions, strict=True)
        for ours, theirs in ((one.observations, other.observations), (one.labels, other.labels)):
            assert set(ours) == set(theirs)
            for key in ours:
                np.testing.assert_array_equal(ours[key], theirs[key], strict=True)


def test_only_what_is_asked_for_is_read(path: Path) -> None:
    demonstrations().write(path)
    with h5py.File(path, "r+") as file:
        del file["data/demo_4/obs/camera"]
    read = Demonstrations.read(path, ["pose"], ())
    assert read.observation_shapes == {"pose": (3,)}
    assert read[0].labels == {}
    assert Demonstrations.read(path, []).observation_shapes == {}


def test_types_in_memory(path: Path) -> None:
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["actions"] = np.ones((3, 2), np.float32)
        demo["obs/pose"] = np.ones((3, 2), np.int16)
        demo["obs/camera"] = np.ones((3, 4, 4, 3), np.uint8)
        demo["labels/phase"] = np.ones(3, np.int8)
    (read,) = Demonstrations.read(path, labels=["phase"])
    arrays = {"actions": read.actions, **read.observations, **read.labels}
    types = {"actions": np.float64, "pose": np.float64, "camera": np.uint8, "phase": np.int64}
    assert {key: array.dtype for key, array in arrays.items()} == types
    assert read.attributes == {}


def test_the_layout_is_robomimics(path: Path) -> None:
    demonstrations(3, {"train": ("demo_1",)}).write(path)
    with h5py.File(path) as file:
        assert sorted(file) == ["data", "mask"]
        assert file["data"].attrs["total"] == 3 + 4 + 5
        assert file["data/demo_1"].attrs["num_samples"] == 4
        assert sorted(file["data/demo_1"]) == ["actions", "labels", "obs"]
        assert file["mask/train"][()].tolist() == [b"demo_1"]


@pytest.mark.skipif(not METAWORLD.exists(), reason="the Meta-World demonstrations are not on this machine")
def test_a_file_by_somebody_else() -> None:
    read = Demonstrations.read(METAWORLD, ["hand_pos", "object_pos"], ["phase"])
    assert (len(read), sum(read.lengths), read.control_size) == (50, 2950, 4)
    assert read.names[:3] == ("demo_0", "demo_1", "demo_2")
    assert read.observation_shapes == {"hand_pos": (3,), "object_pos": (3,)}
    assert set(np.concatenate([demo.labels["phase"] for demo in read])) == {0, 1, 2, 3}
    train, valid = read.split(0.5, seed=0)
    assert (train.names, valid.names) == (read.masks["train"], read.masks["valid"])
    assert (len(train), len(valid)) == (40, 10)


def test_select() -> None:
    demos = demonstrations(5, {"valid": ("demo_0",)})
    chosen = demos.select(["demo_3", "demo_1"])
    assert chosen.names == ("demo_3", "demo_1")
    assert chosen.masks == {}
    says = r"^there is no demonstration 'demo_33' \(did you mean 'demo_3'\?\)$"
    with pytest.raises(DemonstrationsError, match=says):
        demos.select(["demo_33"])


@given(st.integers(2, 30), st.floats(0.001, 0.999), st.integers(0, 2**32 - 1))
def test_a_split_is_a_partition(number: int, fraction: float, seed: int) -> None:
    records = tuple(Demonstration(f"demo_{index}", {}, np.zeros((1, 1))) for index in range(number))
    demos = Demonstrations(records)
    train, valid = demos.split(fraction, seed)
    assert len(train) >= 1
    assert abs(len(valid) - fraction * number) <= 1
    assert set(train.names) | set(valid.names) == set(demos.names)
    assert len(train) + len(valid) == number
    again = demos.split(fraction, seed)
    assert (again[0].names, again[1].names) == (train.names, valid.names)


@pytest.mark.parametrize(
    ("masks", "train", "valid"),
    [
        ({"train": ("demo_1",), "valid": ("demo_3", "demo_0")}, ["demo_1"], ["demo_3", "demo_0"]),
        ({"valid": ("demo_3", "demo_0")}, ["demo_1", "demo_2"], ["demo_3", "demo_0"]),
        ({"train": ("demo_1", "demo_3")}, ["demo_1", "demo_3"], ["demo_0", "demo_2"]),
    ],
)
def test_masks_decide_a_split(masks: dict[str, tuple[str, ...]], train: list[str], valid: list[str]) -> None:
    parts = demonstrations(4, masks).split(0.5, seed=0)
    assert [list(part.names) for part in parts] == [train, valid]


Change = Callable[[h5py.File], object]


def replace(place: str, data: object) -> Change:
    """A change of a file: what is at ``place`` becomes ``data``."""
    return lambda file: instead(file, place, data)


def remove(place: str) -> Change:
    return lambda file: file.pop(place)


def without_steps(file: h5py.File) -> None:
    file["data/demo_1"].attrs["num_samples"] = 0
    for key, size in (("actions", 2), ("obs/pose", 3), ("labels/phase", 0)):
        instead(file, f"data/demo_1/{key}", np.zeros((0, size) if size else 0, float if size else int))


NAN = np.array([[0.0, 1.0], [2.0, np.nan], [0.0, 0.0], [0.0, 0.0]])

DEMO, ACTIONS = ("data/demo_1", "data/demo_1/actions")
OBS, POSE = ("data/demo_1/obs", "data/demo_1/obs/pose")
REFUSED: list[tuple[str, Change, str]] = [
    ("no data", remove("data"), "data is missing; there is: mask"),
    ("no demonstrations", lambda file: file["data"].clear(), "holds no demonstrations; at least one is"),
    ("no actions", remove(ACTIONS), "demo_1: actions is missing; there is: labels/phase, obs/camera"),
    ("group", lambda file: instead(file, ACTIONS, file["mask"]), "demo_1: actions has to be a dataset"),
    ("no obs", remove("data/demo_1/obs"), "demo_1: obs is missing; there is: actions, labels"),
    ("typo", lambda file: file[OBS].move("pose", "poze"), "demo_1: obs/pose is missing (did you mean"),
    ("short obs", replace(POSE, np.ones((3, 3))), "demo_1: obs/pose has 3 steps, but actions has 4"),
    ("long labels", replace("data/demo_1/labels/phase", np.ones(5, int)), "demo_1: labels/phase has 5 steps"),
    ("samples", lambda file: file[DEMO].attrs.update(num_samples=7), "demo_1: actions has 4 steps, but num_"),
    ("NaN", replace("data/demo_1/actions", NAN), "demo_1: actions is nan at step 1, index [1]; repair it"),
    ("infinite", replace(POSE, np.full((4, 3), -np.inf)), "demo_1: obs/pose is -inf at step 0"),
    ("text", replace("data/demo_1/actions", [["a"]] * 4), "demo_1: actions holds text, not numbers"),
    ("other obs shape", replace("data/demo_1/obs/pose", np.ones((4, 2))), "demo_1: obs/pose has shape"),
    ("no steps", without_steps, "demo_1: actions has no steps; remove this demonstration"),
    (
        "more",
        lambda file: file["data/demo_2/obs"].__setitem__("extra", np.ones((5, 1))),
        "demo_2: obs/extra is not in demo_0",
    ),
    ("unknown in mask", replace("mask/valid", [b"demo_11"]), "mask/valid: there is no demonstration 'demo_1"),
]


@pytest.mark.parametrize(("change", "message"), [row[1:] for row in REFUSED], ids=[row[0] for row in REFUSED])
def test_refused_in_one_line(path: Path, change: Change, message: str) -> None:
    demonstrations(3, {"valid": ("demo_1",)}).write(path)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(DemonstrationsError) as caught:
        Demonstrations.read(path, None if "extra" in message else ["pose"], ["phase"])
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_hdf5(tmp_path: Path) -> None:
    with pytest.raises(DemonstrationsError, match=r"none\.hdf5: there is no such file; check the path$"):
        Demonstrations.read(tmp_path / "none.hdf5")
    (tmp_path / "text.hdf5").write_text("these are no demonstrations")
    with pytest.raises(DemonstrationsError, match=r"text\.hdf5: cannot be read, or is damaged"):
        Demonstrations.read(tmp_path / "text.hdf5")


def test_files_that_are_cut_short(path: Path) -> None:
    demonstrations(3).write(path)
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 20, dtype=int):
        path.write_bytes(whole[:length])
        with pytest.raises(DemonstrationsError, match=r"demos\.hdf5: "):
            Demonstrations.read(path)


def test_damaged_data_is_refused(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("data/demo_0/actions", data=np.arange(4000.0).reshape(2000, 2), fletcher32=True)
    spoil(path, "data/demo_0/actions")
    says = r"demo_0: actions cannot be read .* the file may be damaged$"
    with pytest.raises(DemonstrationsError, match=says):
        Demonstrations.read(path, [])


def test_what_is_made_in_memory_is_checked_too() -> None:
    with pytest.raises(DemonstrationsError, match="there are no demonstrations"):
        Demonstrations(())
    with pytest.raises(DemonstrationsError, match="demo_0: there are two demonstrations of this name"):
        Demonstrations((demonstration("demo_0"), demonstration("demo_0")))
    with pytest.raises(DemonstrationsError, match="'a/b' cannot be the name of a demonstration"):
        demonstration("a/b")
