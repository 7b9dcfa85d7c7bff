"""Layouts of other libraries: read where they are a few other names, else named with what converts them."""

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import refused
from odd_files import layouts as odd
from random_demonstrations import demonstrations

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.errors import command


def imported(path: Path, tmp_path: Path) -> Demonstrations:
    out = tmp_path / "demos.hdf5"
    import_demonstrations(path, out)
    return Demonstrations.read(out)


def same_controls(demos: Demonstrations) -> None:
    assert demos.names == ("demo_0", "demo_1", "demo_2")
    for number, demo in enumerate(demos):
        np.testing.assert_array_equal(demo.actions, odd.control(number))


@pytest.mark.parametrize("obs", ["array", "tree"])
def test_maniskill(obs: str, tmp_path: Path) -> None:
    path = odd.maniskill(tmp_path, obs)
    assert inspect(path).format == "maniskill"
    demos = imported(path, tmp_path)
    same_controls(demos)
    key = {"array": "state", "tree": "agent/qpos"}[obs]
    for number, demo in enumerate(demos):
        np.testing.assert_array_equal(demo.observations[key], odd.state(number))
    if obs == "tree":
        np.testing.assert_array_equal(demos[1].observations["extra/is_grasped"].ravel(), [0, 0, 1, 1, 1])


@pytest.mark.parametrize("encoded", [False, True])
def test_act(encoded: bool, tmp_path: Path) -> None:
    folder = odd.act(tmp_path, encoded)
    assert inspect(folder).format == "act"
    demos = imported(folder, tmp_path)
    same_controls(demos)
    for number, demo in enumerate(demos):
        np.testing.assert_array_equal(demo.observations["qpos"], odd.state(number))
        seen = np.asarray(demo.observations["images/top"])
        np.testing.assert_allclose(seen, odd.pictures(number), atol=2 * encoded)  # JPEG


def test_the_base_of_a_mobile_robot_is_part_of_its_control(tmp_path: Path) -> None:
    demos = imported(odd.act(tmp_path, base=True), tmp_path)
    for number, demo in enumerate(demos):
        np.testing.assert_array_equal(demo.actions, np.hstack([odd.control(number), -odd.control(number)]))


@pytest.mark.parametrize(
    "name", [name for name, row in odd.ROWS.items() if row.says not in (None, odd.IMPORT)]
)
def test_what_is_not_read_is_named_with_a_remedy(name: str, tmp_path: Path) -> None:
    row = odd.ROWS[name]
    path = row.make(tmp_path)
    ended = refused("", "import", path, "--out", tmp_path / "demos.hdf5")
    assert re.search(row.says, ended.err), ended.err
    assert not list(tmp_path.glob("*demos*"))
    assert "\x1b" not in ended.err


def test_what_is_to_be_imported_first_is_named(tmp_path: Path) -> None:
    for name, row in odd.ROWS.items():
        if row.says == odd.IMPORT:
            (tmp_path / name).mkdir()
            path = row.make(tmp_path / name)
            first = f"first: {command('import', path, '--out', 'demos.hdf5')}"
            refused(first, "init", path, "--out", tmp_path / "spec.yaml")
            with pytest.raises(DemonstrationsError, match=re.escape(first)):
                Demonstrations.read(path)


def test_files_of_a_folder_are_pooled_with_their_names_as_task(tmp_path: Path) -> None:
    folder = tmp_path / "tasks"
    folder.mkdir()
    counts = {"close": 2, "open_10": 3}
    parts = {task: demonstrations(count, {"valid": ("demo_1",)}) for task, count in counts.items()}
    for task, demos in parts.items():
        replace(demos, attributes={"control_frequency": 20}).write(folder / f"{task}.hdf5")
    assert inspect(folder).format == "folder"
    pooled = imported(folder, tmp_path)
    opened = ("open_10_demo_0", "open_10_demo_1", "open_10_demo_2")
    assert pooled.names == ("close_demo_0", "close_demo_1", *opened)
    assert pooled.masks == {"valid": ("close_demo_1", "open_10_demo_1")}
    assert pooled.frequency == 20
    each = [(task, demo) for task, part in parts.items() for demo in part]
    for demo, (task, own) in zip(pooled, each, strict=True):
        assert demo.attributes["task"] == task
        np.testing.assert_array_equal(demo.actions, own.actions)
        np.testing.assert_array_equal(demo.observations["pose"], own.observations["pose"])
    with h5py.File(folder / "open_10.hdf5", "r+") as file:
        del file["data/demo_0/obs/pose"]
    says = "open_10_demo_0: obs/pose is missing, which close_demo_0 has"
    with pytest.raises(DemonstrationsError, match=says):
        import_demonstrations(folder, tmp_path / "again.hdf5")
