"""Commands that were killed (SIGKILL) or terminated (SIGTERM) go on when they are called again.

The files they write are equal to those of an undisturbed run; what is there is always whole.
"""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import selecting
import toy_task
import yaml
from killing import Kept, until_done, whole
from random_demonstrations import numbered

from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.tensors import read_tensors
from ddco_pyro.fitting import digest
from ddco_pyro.spec import load_spec
from ddco_pyro.training.data import demonstrations as demonstrations_of


def same_hdf5(one: Path, other: Path) -> None:
    """Equal names, arrays and attributes."""

    def contents(path: Path) -> dict[str, object]:
        found: dict[str, object] = {}
        with h5py.File(path) as file:
            found["/"] = dict(file.attrs)
            file.visititems(lambda name, node: found.update({name: (dict(node.attrs), values(node))}))
        return found

    def values(node: h5py.HLObject) -> object:
        return node[()] if isinstance(node, h5py.Dataset) else None

    np.testing.assert_equal(contents(one), contents(other))


def same_run(one: Path, other: Path) -> None:
    """Equal weights, history and numbers, bit for bit, and equal demonstrations.

    Seconds and places differ, and figures are drawn from the rest.
    """
    files = {path.relative_to(one) for path in one.rglob("*") if path.is_file()}
    assert files == {path.relative_to(other) for path in other.rglob("*") if path.is_file()}
    for path in files:
        if path.suffix in (".safetensors", ".csv", ".yaml"):
            assert (one / path).read_bytes() == (other / path).read_bytes(), path
        if path.name == digest.NAME:
            each = [digest.recorded((folder / path).parent) for folder in (one, other)]
            assert digest.difference(*each) == "", path
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (one, other)]
    aside = {"seconds": ...}
    assert metrics[0] | aside == metrics[1] | aside


def same_rollouts(one: Path, other: Path) -> None:
    """Equal outcomes of every episode, and what is said of them."""
    assert (one / "rollouts.csv").read_bytes() == (other / "rollouts.csv").read_bytes()
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (one, other)]
    assert metrics[0] == metrics[1]


def same_selection(one: Path, other: Path) -> None:
    """Equal folds, scores, choice, and fit of what was chosen."""
    for name in ("spec.yaml", "demonstrations.json", "folds.json", "selection.json", "selection.md"):
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    scores = [selecting.kept(folder) for folder in (one, other)]
    for found in [*scores[0].values(), *scores[1].values()]:
        del found["seconds"]
    assert scores[0] == scores[1]
    same_run(one / "fit", other / "fit")


def same_segments(one: Path, other: Path) -> None:
    """Equal labels, and the same table and page beside."""
    same_hdf5(one, other)
    for name in ("a.csv", "a.html"):
        assert one.with_name(name).read_bytes() == other.with_name(name).read_bytes()


def written(paths: Iterable[Path]) -> set[object]:
    """Files, each with the moment at which it was written."""
    return {(path.name, path.stat().st_ino, path.stat().st_mtime_ns) for path in paths}


def folds(folder: Path) -> set[object]:
    """Those of a selection that are done, and the epochs of its models."""
    return written(folder.glob("selected/folds/*.json")) | epochs(folder)


def epochs(folder: Path) -> set[object]:
    """The epochs of every model that need not be trained again."""
    found: set[object] = set()
    for path in folder.rglob("checkpoints/restart-*.safetensors"):
        history = json.loads(read_tensors(path)[1]["progress"])["history"]
        found |= {(path.parts[-3], path.name, number) for number in range(len(history))}
    return found


@dataclass(frozen=True)
class Case:
    """What a command writes, how two of those are compared, what it keeps on the way, and the inputs that are in its
    folder from the beginning.
    """

    result: str
    same: Callable[[Path, Path], None]
    kept: Kept = lambda folder: None
    inputs: tuple[str, ...] = ()


CASES = {
    "collect": Case("demos.hdf5", same_hdf5),
    "fit": Case("fitted", same_run, epochs),
    "fit to pictures": Case("seen", same_run, epochs),
    "select": Case("selected", same_selection, folds),
    "segment": Case("labelled.hdf5", same_segments),
    "segment in place": Case("toy.hdf5", same_segments, inputs=("toy.hdf5",)),
    "rollout": Case("run", same_rollouts, inputs=("elsewhere/run",)),
}
COMMANDS = {
    "collect": "collect {inputs}/toy.yaml --out demos.hdf5 --set demonstrations.count=40 --allow-code",
    "fit": "fit {inputs}/toy.yaml --out fitted --resume --allow-code --set training.epochs=100 "
    "--set compare_with=[flat]",
    "fit to pictures": "fit {inputs}/pictures.yaml --out seen --resume",
    "select": "select {inputs}/grid.yaml --out selected --jobs 2",
    "segment": "segment {inputs}/run {inputs}/toy.hdf5 --out labelled.hdf5 --csv a.csv --html a.html",
    "segment in place": "segment {inputs}/run toy.hdf5 --in-place --csv a.csv --html a.html",
    "rollout": "rollout run --episodes 40 --jobs 2 --allow-code",
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory, toy_run) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "toy.yaml").write_text(toy_task.SPEC.replace("task: toy", "task: toy_task:task"))
    demonstrations_of(load_spec(folder / "toy.yaml", allow_code=True)).write(folder / "toy_source.hdf5")
    import_demonstrations(folder / "toy_source.hdf5", folder / "toy.hdf5")
    write_pictures(folder)
    data = selecting.data_at(folder)
    data["selection"] = data["selection"] | {"folds": 3}
    (folder / "grid.yaml").write_text(yaml.safe_dump(data))
    shutil.copytree(toy_run.folder, folder / "run")
    shutil.copytree(toy_run.folder, folder / "elsewhere" / "run")
    for path in (folder / "elsewhere").rglob("spec.yaml"):  # the task is found where the command is called
        path.write_text(path.read_text().replace("task: toy", "task: toy_task:task"))
    return folder


def write_pictures(folder: Path) -> None:
    """A spec whose pictures are read in two processes."""
    random = np.random.default_rng(0)
    pictures = ({"camera": random.integers(0, 256, (9, 12, 10, 3), dtype=np.uint8)} for _ in range(10))
    numbered((seen, random.normal(size=(9, 2))) for seen in pictures).write(folder / "pictures.hdf5")
    policy = {
        "network": "conv",
        "layers": [{"filters": 2, "kernel": 3, "stride": 2, "padding": 1}],
        "hidden": [4],
        "dropout": 0.1,
    }
    data = {
        "demonstrations": {"path": str(folder / "pictures.hdf5")},
        "observations": [{"key": "camera", "shift": 1}],
        "baseline": {"kind": "flat", "policy": policy},
        "training": {"epochs": 60, "patience": None, "shards": 2, "batch_size": 4},
    }
    (folder / "pictures.yaml").write_text(yaml.safe_dump(data))


def check(name: str, inputs: Path, tmp_path: Path, kills: int, seed: int, by: signal.Signals = signal.SIGKILL) -> int:
    """Undisturbed and killed again and again, each in a folder and with a cache of its own."""
    case, command = CASES[name], COMMANDS[name].format(inputs=inputs).split()
    folders = [tmp_path / each for each in ("whole", "killed")]
    for folder in folders:
        folder.mkdir()
        for path in (Path(toy_task.__file__), *(inputs / each for each in case.inputs)):
            shutil.copytree(path, folder / path.name) if path.is_dir() else shutil.copy(path, folder)
    seconds = whole(command, folders[0], tmp_path / "cache-whole")
    killed = until_done(command, folders[1], tmp_path / "cache-killed", kills, seconds, seed, case.kept, by)
    case.same(folders[0] / case.result, folders[1] / case.result)
    assert not [path for path in folders[1].rglob("*") if path.name.endswith((".tmp", ".lock"))]
    return killed


@pytest.mark.slow
@pytest.mark.parametrize("name", ["collect", "fit", "fit to pictures", "select", "rollout"])
def test_terminated_and_called_again(inputs: Path, tmp_path: Path, name: str) -> None:
    """A scheduler's preemption, five times: each ends with a line, without helpers left behind, and goes on."""
    assert check(name, inputs, tmp_path, kills=5, seed=11, by=signal.SIGTERM) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_killed_at_very_many_moments(inputs: Path, tmp_path: Path, name: str) -> None:
    killed: list[int] = []
    while sum(killed) < 10:  # eighty in all; a moment that comes after the end kills nothing
        folder = tmp_path / str(len(killed))
        folder.mkdir()
        killed.append(check(name, inputs, folder, kills=10, seed=len(killed)))
