"""Demonstrations that cannot be used are refused in one clear line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from random_demonstrations import demonstration, demonstrations

from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "demos.hdf5"


def replace(place: str, data: object) -> Callable[[h5py.File], None]:
    """A change of a file: what is at ``place`` becomes ``data``."""

    def change(file: h5py.File) -> None:
        if place in file:
            del file[place]
        file[place] = data

    return change


def remove(place: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[place]

    return change


def empty(file: h5py.File) -> None:
    for name in list(file["data"]):
        del file["data"][name]


def count_wrongly(file: h5py.File) -> None:
    file["data/demo_1"].attrs["num_samples"] = 7


def group_for_actions(file: h5py.File) -> None:
    del file["data/demo_1/actions"]
    file.create_group("data/demo_1/actions")


NAN = np.array([[0.0, 1.0], [2.0, np.nan], [0.0, 0.0], [0.0, 0.0]])

REFUSED: list[tuple[str, Callable[[h5py.File], None], str]] = [
    ("no data", remove("data"), "data is missing; there is: mask"),
    ("data is an array", replace("data", [1]), "data has to be a group, not a dataset"),
    ("no demonstrations", empty, "the group 'data' holds no demonstrations; at least one is needed"),
    ("no actions", remove("data/demo_1/actions"), "demo_1: actions is missing; there is: labels/phase, obs/camera"),
    ("group for actions", group_for_actions, "demo_1: actions has to be a dataset, not a group"),
    ("no obs", remove("data/demo_1/obs"), "demo_1: obs is missing; there is: actions, labels"),
    ("no such key", remove("data/demo_1/obs/pose"), "demo_1: obs/pose is missing; there is: camera"),
    ("no labels", remove("data/demo_1/labels"), "demo_1: labels is missing; there is: actions, obs"),
    ("short obs", replace("data/demo_1/obs/pose", np.ones((3, 3))), "demo_1: obs/pose has 3 steps, but actions has 4"),
    ("scalar obs", replace("data/demo_1/obs/pose", 3.0), "demo_1: obs/pose has no steps; it has to be an array"),
    ("long labels", replace("data/demo_1/labels/phase", np.ones(5, int)), "demo_1: labels/phase has 5 steps"),
    ("num_samples", count_wrongly, "demo_1: actions has 4 steps, but num_samples is 7"),
    ("NaN", replace("data/demo_1/actions", NAN), "demo_1: actions is nan at step 1, index [1]; repair it"),
    ("infinite", replace("data/demo_1/obs/pose", np.full((4, 3), -np.inf)), "demo_1: obs/pose is -inf at step 0"),
    ("text", replace("data/demo_1/actions", [["a"]] * 4), "demo_1: actions holds object, it has to hold real numbers"),
    ("complex", replace("data/demo_1/actions", np.ones((4, 2), complex)), "demo_1: actions holds complex128"),
    ("flat actions", replace("data/demo_1/actions", np.ones(4)), "demo_1: actions is float64 of shape [steps]"),
    ("float labels", replace("data/demo_1/labels/phase", np.ones(4)), "demo_1: labels/phase is float64 of shape"),
    ("other obs shape", replace("data/demo_1/obs/pose", np.ones((4, 2))), "demo_1: obs/pose has shape"),
    ("other actions shape", replace("data/demo_1/actions", np.ones((4, 3))), "demo_1: actions has shape"),
    ("unknown in mask", replace("mask/valid", [b"demo_11"]), "mask/valid: there is no demonstration 'demo_11'"),
]


@pytest.mark.parametrize(("change", "message"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED])
def test_refused_in_one_line(path: Path, change: Callable[[h5py.File], None], message: str) -> None:
    demonstrations(3, {"valid": ("demo_1",)}).write(path)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(DemonstrationsError) as caught:
        Demonstrations.read(path, ["pose"], ["phase"])
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_demonstrations_without_steps_are_refused(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data/demo_0/actions"] = np.zeros((0, 2))
        file["data/demo_0/obs/pose"] = np.zeros((0, 3))
    with pytest.raises(DemonstrationsError, match=r"demo_0: actions has no steps; remove this demonstration$"):
        Demonstrations.read(path)


def test_a_key_that_differs_between_demonstrations_is_refused(path: Path) -> None:
    demonstrations(3).write(path)
    with h5py.File(path, "r+") as file:
        file["data/demo_2/obs/extra"] = np.ones((5, 1))
    with pytest.raises(DemonstrationsError, match=r"demo_2: obs/extra is not in demo_0; all demonstrations"):
        Demonstrations.read(path)


def test_a_misspelt_key_is_refused_with_the_nearest(path: Path) -> None:
    demonstrations(2).write(path)
    with pytest.raises(
        DemonstrationsError, match=r"demo_0: obs/poze is missing \(did you mean 'pose'\?\); there is: camera, pose$"
    ):
        Demonstrations.read(path, ["poze"])


def test_files_that_are_no_hdf5(tmp_path: Path) -> None:
    with pytest.raises(DemonstrationsError, match=r"none\.hdf5: there is no such file; check the path$"):
        Demonstrations.read(tmp_path / "none.hdf5")
    (tmp_path / "text.hdf5").write_text("these are no demonstrations")
    with pytest.raises(DemonstrationsError, match=r"text\.hdf5: cannot be read as HDF5"):
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
    with h5py.File(path) as file:
        offset = file["data/demo_0/actions"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset + 8] ^= 1
    path.write_bytes(content)
    with pytest.raises(DemonstrationsError, match=r"demo_0: actions cannot be read .* the file may be damaged$"):
        Demonstrations.read(path, [])


def test_attributes_that_are_neither_number_nor_text_are_left_alone(path: Path) -> None:
    demonstrations(1).write(path)
    with h5py.File(path, "r+") as file:
        file["data/demo_0"].attrs["array"] = np.ones(3)
        file["data/demo_0"].attrs["nothing"] = h5py.Empty("f8")
        file["data/demo_0"].attrs["reference"] = file["data"].ref
    assert Demonstrations.read(path)[0].attributes == demonstration("demo_0").attributes


def test_what_is_made_in_memory_is_checked_too() -> None:
    with pytest.raises(DemonstrationsError, match="there are no demonstrations"):
        Demonstrations(())
    with pytest.raises(DemonstrationsError, match="demo_0: there are two demonstrations of this name"):
        Demonstrations((demonstration("demo_0"), demonstration("demo_0")))
    with pytest.raises(DemonstrationsError, match="'a/b' cannot be the name of a demonstration"):
        demonstration("a/b")
