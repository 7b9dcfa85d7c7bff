"""Places where nothing can be written: a full disk, a folder that is read-only, a folder that another process is at."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import toy_task
from command_line import call
from killing import HANGS
from random_demonstrations import demonstrations

from ddco_pyro.data.files import only_one, whole_file

NOBODY = 65534


@contextlib.contextmanager
def room(size: int) -> Iterator[None]:
    """No file can grow beyond ``size`` bytes: what the system says is what it says when a disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.hdf5"
    demonstrations(20).write(path)
    return path


@pytest.mark.parametrize(
    "size", [5000, 60_000, *(pytest.param(size, marks=pytest.mark.slow) for size in (0, 100, 20_000))]
)
def test_a_full_disk_while_importing(source: Path, tmp_path: Path, size: int) -> None:
    out = tmp_path / "out.hdf5"
    with room(size):
        ended = call("import", source, "--out", out)
    last = ended.err.splitlines()[-1]
    assert ended.status == 1, ended.err
    assert "there is no room to write it; free some space, then do the same again" in last
    assert not out.exists()
    assert not list(tmp_path.rglob("*.tmp"))
    assert call("import", source, "--out", out).status == 0
    assert call("import", source, "--out", tmp_path / "again.hdf5").status == 0
    assert out.read_bytes() == (tmp_path / "again.hdf5").read_bytes()


@pytest.mark.parametrize("size", [0, 3000])
def test_a_full_disk_while_segmenting(toy_run, toy_spec, tmp_path: Path, size: int) -> None:
    from ddco_pyro.training.data import demonstrations as of

    path = tmp_path / "demos.hdf5"
    of(toy_spec).write(path)
    before = path.read_bytes()
    for more in (["--csv", tmp_path / "a.csv"], ["--html", tmp_path / "a.html"]):
        with room(size):
            ended = call("segment", toy_run.folder, path, "--in-place", *more)
        assert ended.status == 1
        assert "there is no room to write it" in ended.err.splitlines()[-1]
    assert path.read_bytes() == before
    assert {one.name for one in tmp_path.iterdir()} <= {"demos.hdf5", "a.csv"}  # whole, or not there


def test_a_full_disk_while_fitting(tmp_path: Path, cache) -> None:
    spec = tmp_path / "toy.yaml"
    spec.write_text(toy_task.SPEC)
    short = ["--set", "training.epochs=2", "--set", "compare_with=[]"]
    with room(4000):
        ended = call("fit", spec, "--out", tmp_path / "run", *short)
    assert ended.status == 1
    assert "there is no room to write it" in ended.err.splitlines()[-1]
    assert call("fit", spec, "--out", tmp_path / "run", *short).status == 0
    assert call("fit", spec, "--out", tmp_path / "other", *short).status == 0
    assert (tmp_path / "run/model.safetensors").read_bytes() == (tmp_path / "other/model.safetensors").read_bytes()


AS_NOBODY = """
import os, sys
from pathlib import Path
from ddco_pyro.data.files import NotWritable, only_one, write_text
os.setuid(int(sys.argv[2])) if os.getuid() == 0 else None
folder = Path(sys.argv[1])
for attempt in (lambda: write_text(folder / "file", "x"), lambda: only_one(folder / "run").__enter__()):
    try:
        attempt()
    except NotWritable as error:
        print(error)
"""


def test_a_read_only_folder(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    folder.chmod(0o555)
    for above in [tmp_path, *tmp_path.parents][:3]:
        above.chmod(above.stat().st_mode | 0o055)
    command = [sys.executable, "-c", AS_NOBODY, str(folder), str(NOBODY)]
    ended = subprocess.run(command, capture_output=True, text=True)
    lines = ended.stdout.splitlines()
    reason = "cannot be written: Permission denied; choose another place or change this one"
    assert lines == [f"{folder}/file: {reason}", f"{folder}/run: {reason}"], ended.stderr


def test_who_waits_goes_on_when_the_other_has_ended(tmp_path: Path) -> None:
    """And notices that the other removed the folder, to make its own."""
    folder, order = tmp_path / "parts", []

    def wait() -> None:
        with only_one(folder, wait=True):
            order.append("second")
            assert folder.exists()

    with only_one(folder):
        other = threading.Thread(target=wait)
        other.start()
        other.join(0.2)
        order.append("first")
        shutil.rmtree(folder)
    other.join(HANGS)
    assert order == ["first", "second"]


def test_a_second_process_on_a_run_is_refused(tmp_path: Path) -> None:
    spec, folder = tmp_path / "toy.yaml", tmp_path / "run"
    spec.write_text(toy_task.SPEC)
    with only_one(folder):
        ended = call("fit", spec, "--out", folder)
    assert (ended.status, ended.err) == (
        2, f"ddco-pyro: {folder}: another process is at work on it; wait for it, or choose another place\n",
    )  # fmt: skip
    assert not any(folder.iterdir())  # the other may be about to write its own spec


def test_what_the_dead_have_left_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "file"
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    with whole_file(path) as temporary:
        name = temporary.name
        stale = tmp_path / name.replace(f"-{os.getpid()}-", f"-{dead.pid}-")
        stale.touch()
        with whole_file(path) as second:  # it removes what the dead have left, not what is being written
            second.write_text("second")
        assert not stale.exists()
        temporary.write_text("first")
    assert path.read_text() == "first"
    assert [one.name for one in tmp_path.iterdir()] == ["file"]
