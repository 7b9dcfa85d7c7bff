"""Commands that were killed go on when they are called again, to the results of an undisturbed run."""

import json
import shutil
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import selecting
import toy_task
import yaml
from killing import HANGS, killed

from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import demonstrations

COMMANDS = {
    "collect": "collect toy.yaml --out collected.hdf5 --set demonstrations.count=40 --allow-code",
    "fit": "fit toy.yaml --out out --resume --allow-code --set training.epochs=100 --set compare_with=[flat]",
    "select": "select grid.yaml --out out --jobs 2 --resume",
    "segment": "segment run toy.hdf5 --in-place --csv out.csv --html out.html --allow-code",
    "rollout": "rollout run --episodes 40 --jobs 2 --allow-code",
}


@pytest.fixture
def inputs(tmp_path: Path, toy_run) -> Path:
    folder = tmp_path / "inputs"
    shutil.copytree(toy_run.folder, folder / "run")
    shutil.copy(toy_task.__file__, folder)
    for path in (folder / "run").rglob("spec.yaml"):  # the task is found where the command is called
        path.write_text(path.read_text().replace("task: toy", "task: toy_task:task"))
    (folder / "toy.yaml").write_text(toy_task.SPEC.replace("task: toy", "task: toy_task:task"))
    demonstrations(load_spec(folder / "toy.yaml", allow_code=True)).write(folder / "toy.hdf5")
    (folder / "grid.yaml").write_text(yaml.safe_dump(selecting.data_at(folder)))
    return folder


def results(folder: Path) -> dict[str, object]:
    """What a folder holds: bytes of files, what is in HDF5 files, and numbers of JSON files, without seconds
    and places.
    """
    found = {}
    for path in folder.rglob("*"):
        if path.suffix == ".json":
            found[str(path.relative_to(folder))] = json.loads(path.read_text()) | {"seconds": 0, "files": 0}
        elif path.suffix == ".hdf5":
            found[str(path.relative_to(folder))] = contents(path)
        elif path.suffix in (".safetensors", ".csv", ".md"):
            found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def contents(path: Path) -> dict[str, object]:
    """Attributes and numbers by name; a file that is labelled twice has other bytes."""
    with h5py.File(path) as file:
        every = [file]
        file.visititems(lambda _, one: every.append(one))
        return {
            one.name: (
                {key: np.asarray(value).tolist() for key, value in one.attrs.items()},
                np.asarray(one).tolist() if isinstance(one, h5py.Dataset) else None,
            )
            for one in every
        }


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_killed_and_called_again(inputs: Path, tmp_path: Path, name: str) -> None:
    """Killed at a quarter, a half and three quarters of the time that the command takes."""
    command, (whole, other) = COMMANDS[name].split(), (tmp_path / "whole", tmp_path / "killed")
    for folder in (whole, other):
        shutil.copytree(inputs, folder)
    start = time.monotonic()
    assert not killed(command, whole, tmp_path / "cache", HANGS)
    seconds = time.monotonic() - start
    ended = [killed(command, other, tmp_path / "other cache", part * seconds) for part in (0.25, 0.5, 0.75)]
    assert any(ended)
    assert not killed(command, other, tmp_path / "other cache", HANGS)
    assert results(other) == results(whole)
    assert not [path for path in other.rglob("*") if path.suffix in (".tmp", ".lock")]
