"""Demonstrations: what is read is what was written; as a sequence; splits."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from random_demonstrations import demonstrations

from ddco_pyro.data.checks import LARGEST
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError

METAWORLD = Path(__file__).parents[2] / "shared" / "data" / "metaworld_pick_place.hdf5"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "demos.hdf5"


def assert_equal(one: Demonstration, other: Demonstration) -> None:
    assert (one.name, one.attributes) == (other.name, other.attributes)
    np.testing.assert_array_equal(one.actions, other.actions, strict=True)
    for ours, theirs in ((one.observations, other.observations), (one.labels, other.labels)):
        assert set(ours) == set(theirs)
        for key in ours:
            np.testing.assert_array_equal(ours[key], theirs[key], strict=True)


# --- reading and writing ----------------------------------------------------------------------------------------------


def test_what_is_read_is_what_was_written(path: Path) -> None:
    original = demonstrations(masks={"valid": ("demo_2", "demo_10"), "none": ()})
    original.write(path)
    read = Demonstrations.read(path, labels=["phase"])
    assert read.names == original.names
    assert (read.masks, read.attributes) == (original.masks, original.attributes)
    for one, other in zip(read, original, strict=True):
        assert_equal(one, other)


@settings(max_examples=40)
@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(1, 5), st.integers(1, 3)),
        elements={"min_value": -LARGEST, "max_value": LARGEST},
    )
)
def test_numbers_survive_exactly(tmp_path_factory: pytest.TempPathFactory, actions: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("demos") / "demos.hdf5"
    Demonstrations((Demonstration("demo_0", {"x": actions}, actions),)).write(path)
    (read,) = Demonstrations.read(path)
    np.testing.assert_array_equal(read.actions, actions, strict=True)
    np.testing.assert_array_equal(read.observations["x"], actions, strict=True)


def test_only_what_is_asked_for_is_read(path: Path) -> None:
    demonstrations().write(path)
    with h5py.File(path, "r+") as file:
        file["data/demo_3/obs/camera"][...] = 0
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
    types = [
        array.dtype
        for array in (read.actions, read.observations["pose"], read.observations["camera"], read.labels["phase"])
    ]
    assert types == [np.float64, np.float64, np.uint8, np.int64]
    assert read.attributes == {}


def test_the_layout_is_robomimics(path: Path) -> None:
    demonstrations(3, {"train": ("demo_1",)}).write(path)
    with h5py.File(path) as file:
        assert sorted(file) == ["data", "mask"]
        assert file["data"].attrs["total"] == 3 + 4 + 5
        assert file["data/demo_1"].attrs["num_samples"] == 4
        assert sorted(file["data/demo_1"]) == ["actions", "labels", "obs"]
        assert file["mask/train"][()].tolist() == [b"demo_1"]


def test_equal_demonstrations_give_equal_files(path: Path) -> None:
    demonstrations(2).write(path)
    other = path.with_name("other.hdf5")
    demonstrations(2).write(other)
    assert path.read_bytes() == other.read_bytes()


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


# --- as a sequence ----------------------------------------------------------------------------------------------------


def test_demonstrations_are_a_sequence() -> None:
    demos = demonstrations(5)
    assert len(demos) == 5
    assert [demo.name for demo in demos] == list(demos.names)
    assert demos[-1].name == "demo_4"
    assert [demo.name for demo in demos[1:3]] == ["demo_1", "demo_2"]
    assert demos.lengths == (3, 4, 5, 6, 3)
    assert demos.observation_shapes == {"pose": (3,), "camera": (6, 5, 3)}
    assert demos.control_size == 2


def test_select() -> None:
    demos = demonstrations(5, {"valid": ("demo_0",)})
    chosen = demos.select(["demo_3", "demo_1"])
    assert chosen.names == ("demo_3", "demo_1")
    assert chosen.masks == {}
    with pytest.raises(DemonstrationsError, match=r"^there is no demonstration 'demo_33' \(did you mean 'demo_3'\?\)$"):
        demos.select(["demo_33"])


# --- splits -----------------------------------------------------------------------------------------------------------


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


def test_the_seed_decides_a_split() -> None:
    demos = demonstrations(12)
    assert len({demos.split(0.3, seed)[1].names for seed in range(8)}) > 1


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


@pytest.mark.parametrize(
    ("number", "masks", "message"),
    [
        (1, {}, "no demonstration is left to validate with; add some or change the masks"),
        (2, {"valid": ("demo_0", "demo_1")}, "no demonstration is left to train with; add some or change the masks"),
        (2, {"valid": ()}, "no demonstration is left to validate with; add some or change the masks"),
        (
            2,
            {"train": ("demo_1",), "valid": ("demo_1",)},
            "demo_1 is in mask/train and in mask/valid; remove it from one",
        ),
    ],
)
def test_splits_that_cannot_be(number: int, masks: dict[str, tuple[str, ...]], message: str) -> None:
    with pytest.raises(DemonstrationsError, match=f"^{re.escape(message)}$"):
        demonstrations(number, masks).split(0.5, seed=0)
