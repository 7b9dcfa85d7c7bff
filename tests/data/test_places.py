"""Places where nothing can be written: a full disk, a read-only folder, one that another process is at."""

import os
import resource
import shutil
import threading
from pathlib import Path
from tempfile import gettempdir

import forked
import pytest
import torch
import toy_task
from command_line import call, done
from killing import HANGS
from random_demonstrations import demonstrations

from ddco_pyro.data.files import only_one, whole_file, whole_folder, write_text
from ddco_pyro.data.tensors import read_tensors, write_tensors
from ddco_pyro.errors import BadInput
from ddco_pyro.training.data import demonstrations as of


def fails_on_a_full_disk(size: int, *command: object) -> None:
    """No file can grow beyond ``size`` bytes: what the system says is what it says when a disk is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        ended = call(*command)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert ended.status == 1, ended.err
    says = "there is no room to write it; free some space, then do the same again"
    assert says in ended.err.splitlines()[-1]


@pytest.mark.parametrize(
    "size", [5000, *(pytest.param(size, marks=pytest.mark.slow) for size in (0, 60_000))]
)
def test_a_full_disk_while_importing(tmp_path: Path, size: int) -> None:
    source, out = tmp_path / "source.hdf5", tmp_path / "out.hdf5"
    demonstrations(20).write(source)
    fails_on_a_full_disk(size, "import", source, "--out", out)
    assert not out.exists()
    assert not list(tmp_path.rglob("*.tmp"))
    done("import", source, "--out", out)
    done("import", source, "--out", tmp_path / "again.hdf5")
    assert out.read_bytes() == (tmp_path / "again.hdf5").read_bytes()


def test_a_full_disk_while_segmenting(toy_run, toy_spec, tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    of(toy_spec).write(path)
    before = path.read_bytes()
    for more in (["--csv", tmp_path / "a.csv"], ["--html", tmp_path / "a.html"]):
        fails_on_a_full_disk(3000, "segment", toy_run.folder, path, "--in-place", *more)
    assert path.read_bytes() == before
    assert {one.name for one in tmp_path.iterdir()} <= {"demos.hdf5", "a.csv"}  # whole, or not there


def test_a_full_disk_while_fitting(tmp_path: Path, cache) -> None:
    spec = tmp_path / "toy.yaml"
    spec.write_text(toy_task.SPEC)
    short = ["--set", "training.epochs=2", "--set", "compare_with=[]"]
    fails_on_a_full_disk(4000, "fit", spec, "--out", tmp_path / "run", *short)
    done("fit", spec, "--out", tmp_path / "run", *short)
    done("fit", spec, "--out", tmp_path / "other", *short)
    run, other = ((tmp_path / name / "model.safetensors").read_bytes() for name in ("run", "other"))
    assert run == other


def test_a_read_only_folder(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    folder.chmod(0o555)
    ours = [
        one
        for one in (tmp_path, *tmp_path.parents)
        if one.is_relative_to(gettempdir()) and one != Path(gettempdir())
    ]
    for above in ours:
        above.chmod(above.stat().st_mode | 0o055)

    def as_nobody() -> list[str]:
        if os.getuid() == 0:
            os.setuid(65534)  # nobody
        said = []
        claims = (lambda: write_text(folder / "file", "x"), lambda: only_one(folder / "run").__enter__())
        for attempt in claims:
            with pytest.raises(BadInput) as refused:
                attempt()
            said.append(str(refused.value))
        return said

    reason = "cannot be written: Permission denied; choose another place or change this one"
    assert forked.run(as_nobody).value == [f"{folder}/file: {reason}", f"{folder}/run: {reason}"]


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
    dead = forked.run(os.getpid).value
    with whole_file(path) as temporary:
        name = temporary.name
        stale = tmp_path / name.replace(f"-{os.getpid()}-", f"-{dead}-")
        stale.touch()
        with whole_file(path) as second:  # it removes what the dead have left, not what is being written
            second.write_text("second")
        assert not stale.exists()
        temporary.write_text("first")
    assert path.read_text() == "first"
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


# --- files appear whole or not at all -----------------------------------------------------------------------


def test_a_write_that_is_cut_off_leaves_what_was_there(tmp_path):
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def write():
        with whole_file(path) as temporary:
            temporary.write_text("half of")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def contents(folder):
    return {str(path.relative_to(folder)): path.is_file() and path.read_text() for path in folder.rglob("*")}


def write_folder(path, text, error=None):
    with whole_folder(path) as temporary:
        (temporary / "deeper").mkdir()
        (temporary / "deeper" / "file").write_text(text)
        assert not path.exists() or contents(path) == {"deeper": False, "deeper/file": "old"}
        if error:
            raise error


def test_a_folder_that_is_cut_off_leaves_what_was_there(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "a" / "folder", "half", KeyboardInterrupt)
    assert contents(tmp_path) == {"a": False}
    write_folder(tmp_path / "folder", "old")
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "folder", "half", KeyboardInterrupt)
    assert contents(tmp_path / "folder") == {"deeper": False, "deeper/file": "old"}
    write_folder(tmp_path / "folder", "new")
    assert contents(tmp_path / "folder") == {"deeper": False, "deeper/file": "new"}
    assert {path.name for path in tmp_path.iterdir()} == {"a", "folder"}
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o755


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "there").mkdir()
    link, folder = tmp_path / "link", tmp_path / "folder"
    link.symlink_to(tmp_path / "there" / "file")
    write_text(link, "first")  # it led nowhere
    write_text(link, "second")
    write_folder(tmp_path / "there" / "folder", "old")
    folder.symlink_to(tmp_path / "there" / "folder")
    write_folder(folder, "new")
    assert link.is_symlink()
    assert folder.is_symlink()
    assert (tmp_path / "there" / "file").read_text() == "second"
    assert (tmp_path / "there" / "folder" / "deeper" / "file").read_text() == "new"
    assert {path.name for path in (tmp_path / "there").iterdir()} == {"file", "folder"}


def test_tensors_and_metadata_come_back_bit_for_bit(tmp_path):
    tensors = {
        "float": torch.randn(3, 4, generator=torch.Generator().manual_seed(0)),
        "double": torch.tensor([1 / 3, -torch.inf], dtype=torch.float64),
        "turned": torch.arange(6).reshape(2, 3).T,
    }
    write_tensors(tmp_path / "file", tensors, {"steps": "7"})
    found, metadata = read_tensors(tmp_path / "file")
    assert metadata == {"steps": "7"}
    assert set(found) == set(tensors)
    for name, value in tensors.items():
        torch.testing.assert_close(found[name], value, atol=0, rtol=0)


def test_equal_tensors_give_equal_files(tmp_path):
    metadata = {letter: f"{letter} σ" for letter in "abcdefgh"}
    for number in range(3):
        write_tensors(tmp_path / str(number), {"x": torch.ones(2), "y": torch.zeros(1)}, metadata)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    assert read_tensors(tmp_path / "0")[1] == metadata
