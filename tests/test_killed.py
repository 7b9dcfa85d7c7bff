"""Commands that were killed (SIGKILL) go on when they are called again, and end as if nothing had happened.

The files they were to write are equal to those of an undisturbed run; what is there is always whole.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import toy_task
from killing import until_done, whole
from random_demonstrations import demonstrations

from ddco_pyro.importing import import_demonstrations

HERE = Path(__file__).parent


def same_hdf5(one: Path, other: Path) -> None:
    """Equal names, arrays and attributes."""

    def contents(path: Path) -> dict[str, object]:
        found: dict[str, object] = {}
        with h5py.File(path) as file:
            found["/"] = dict(file.attrs)
            file.visititems(lambda name, node: found.update({name: (dict(node.attrs), _values(node))}))
        return found

    np.testing.assert_equal(contents(one), contents(other))


def _values(node: h5py.HLObject) -> object:
    return node[()] if isinstance(node, h5py.Dataset) else None


def same_run(one: Path, other: Path) -> None:
    """Equal weights, history and numbers; seconds differ, and figures are drawn from the rest."""
    files = {path.relative_to(one) for path in one.rglob("*") if path.is_file()}
    assert files == {path.relative_to(other) for path in other.rglob("*") if path.is_file()}
    for path in files:
        if path.suffix in (".safetensors", ".csv", ".yaml"):
            assert (one / path).read_bytes() == (other / path).read_bytes(), path
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (one, other)]
    assert metrics[0] | {"seconds": ...} == metrics[1] | {"seconds": ...}


@dataclass(frozen=True)
class Case:
    """A command, the name of what it writes, and how two of those are compared."""

    arguments: tuple[object, ...]
    result: str
    same: Callable[[Path, Path], None]


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory, toy_run) -> dict[str, Case]:
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "toy.yaml").write_text(toy_task.SPEC)
    demonstrations(300).write(folder / "source.hdf5")
    short = [one for key in ("training.epochs=25", "compare_with=[flat]") for one in ("--set", key)]
    shutil.copytree(toy_run.folder, folder / "run")
    import_demonstrations(_toy_demonstrations(folder), folder / "toy.hdf5")
    return {
        "collect": Case(
            ("collect", folder / "toy.yaml", "--out", "demos.hdf5", "--set", "demonstrations.count=40"),
            "demos.hdf5",
            same_hdf5,
        ),
        "import": Case(("import", folder / "source.hdf5", "--out", "imported.hdf5"), "imported.hdf5", same_hdf5),
        "fit": Case(("fit", folder / "toy.yaml", "--out", "fitted", "--resume", *short), "fitted", same_run),
        "segment": Case(
            (
                "segment",
                folder / "run",
                folder / "toy.hdf5",
                "--out",
                "labelled.hdf5",
                "--csv",
                "a.csv",
                "--html",
                "a.html",
            ),
            "labelled.hdf5",
            same_hdf5,
        ),
    }


def _toy_demonstrations(folder: Path) -> Path:
    from ddco_pyro.data import demonstrations as of
    from ddco_pyro.spec import load_spec

    path = folder / "toy_source.hdf5"
    of(load_spec(folder / "toy.yaml")).write(path)
    return path


def check(case: Case, tmp_path: Path, kills: int, seed: int) -> int:
    """Undisturbed and killed again and again, each in a folder and with a cache of its own."""
    folders = [tmp_path / name for name in ("whole", "killed")]
    for folder in folders:
        folder.mkdir()
        shutil.copy(HERE / "toy_task.py", folder)
    seconds = whole(case.arguments, folders[0], tmp_path / "cache-whole")
    killed = until_done(case.arguments, folders[1], tmp_path / "cache-killed", kills, seconds, seed)
    case.same(folders[0] / case.result, folders[1] / case.result)
    left = [path.name for path in folders[1].rglob("*") if path.name.endswith((".tmp", ".parts"))]
    assert not [name for name in left if case.result in name or case.result == "fitted"], left
    return killed


def test_killed_and_called_again(cases: dict[str, Case], tmp_path: Path) -> None:
    check(cases["import"], tmp_path, kills=2, seed=7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["collect", "import", "fit", "segment"])
def test_killed_at_very_many_moments(cases: dict[str, Case], tmp_path: Path, name: str) -> None:
    killed = round_ = 0
    while killed < 13:  # four commands: 52 moments; a moment that comes after the end kills nothing
        folder = tmp_path / str(round_)
        folder.mkdir()
        killed += check(cases[name], folder, kills=5, seed=round_)
        round_ += 1
    print(f"{name}: killed {killed} times")
