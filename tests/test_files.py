"""Files appear whole or not at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ddco_pyro.data.files import NoSpace, NotWritable, whole_file, whole_folder, write_text
from ddco_pyro.data.tensors import read_tensors, write_tensors


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_write_that_is_cut_off_leaves_what_was_there(tmp_path, error):
    path = tmp_path / "file.txt"
    write_text(path, "old")

    def write():
        with whole_file(path) as temporary:
            temporary.write_text("half of")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_nobody_sees_a_file_before_it_is_whole(tmp_path):
    path = tmp_path / "deeper" / "file.txt"
    with whole_file(path) as temporary:
        temporary.write_text("half")
        assert not path.exists()
        temporary.write_text("whole")
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_mode & 0o777 == 0o644


def contents(folder):
    return {str(path.relative_to(folder)): path.is_file() and path.read_text() for path in folder.rglob("*")}


def write_folder(path, text, error=None):
    with whole_folder(path) as temporary:
        (temporary / "deeper").mkdir()
        (temporary / "deeper" / "file").write_text(text)
        assert not path.exists() or contents(path) == {"deeper": False, "deeper/file": "old"}
        if error:
            raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_folder_that_is_cut_off_leaves_what_was_there(tmp_path, error):
    with pytest.raises(error):
        write_folder(tmp_path / "a" / "folder", "half", error)
    assert contents(tmp_path) == {"a": False}
    write_folder(tmp_path / "folder", "old")
    with pytest.raises(error):
        write_folder(tmp_path / "folder", "half", error)
    assert contents(tmp_path / "folder") == {"deeper": False, "deeper/file": "old"}
    write_folder(tmp_path / "folder", "new")
    assert contents(tmp_path / "folder") == {"deeper": False, "deeper/file": "new"}
    assert {path.name for path in tmp_path.iterdir()} == {"a", "folder"}
    assert (tmp_path / "folder").stat().st_mode & 0o777 == 0o755


KILLED = """
import os, signal
from pathlib import Path
from ddco_pyro.data.files import whole_folder
with whole_folder(Path("folder")) as temporary:
    (temporary / "file").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_of_a_folder_is_removed(tmp_path):
    ended = subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, check=False)
    assert ended.returncode == -signal.SIGKILL
    assert [path.name.startswith(".folder-") for path in tmp_path.iterdir()] == [True]
    write_folder(tmp_path / "folder", "whole")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


class Killed(BaseException):
    """Where a process was killed: nothing of it runs after that."""


@pytest.mark.parametrize("step", ["before the first", "between the two", "after the second"])
def test_a_folder_is_there_whole_wherever_its_writer_was_killed(tmp_path, monkeypatch, step):
    """Killed before or after each of the two renames, the folder is the old or the new one once it is written again."""
    path, rename = tmp_path / "folder", Path.rename
    write_folder(path, "old")
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    renamed = []

    def killed(self, target):
        done = {"before the first": 0, "between the two": 1, "after the second": 2}[step]
        if len(renamed) < done:
            renamed.append(rename(self, target))
        if len(renamed) == done:
            raise Killed

    with monkeypatch.context() as patched:
        patched.setattr("os.getpid", lambda: dead.pid)
        patched.setattr(Path, "rename", killed)
        patched.setattr("shutil.rmtree", lambda *_, **__: None)
        patched.setattr("ddco_pyro.data.files._put_back", lambda *_: None)
        with pytest.raises(Killed):
            write_folder(path, "new")
    assert path.exists() == (step != "between the two")
    with whole_folder(tmp_path / "folder"):  # the next writer
        assert contents(path)["deeper/file"] == ("new" if step == "after the second" else "old")
    assert [one.name for one in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_a_folder_comes_back_where_the_new_one_cannot_take_its_place(tmp_path, monkeypatch, error):
    path, rename, seen = tmp_path / "folder", Path.rename, []
    write_folder(path, "old")

    def fails(self, target):
        seen.append(target)
        if len(seen) == 2:
            raise error
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(error):
        write_folder(path, "new")
    assert contents(tmp_path) == {"folder": False, "folder/deeper": False, "folder/deeper/file": "old"}


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


def test_a_device_is_written_into_and_never_replaced(tmp_path):
    """A terminal, so that what arrives can be read."""
    ours, theirs = os.openpty()
    terminal = Path(os.ttyname(theirs))
    write_text(terminal, "hello")
    assert os.read(ours, 100) == b"hello"
    assert terminal.is_char_device()
    with pytest.raises(NoSpace):
        write_text(Path("/dev/full"), "x")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(NotWritable, match="pipe: is no regular file; choose another place"):
        write_text(tmp_path / "pipe", "x")
    assert (tmp_path / "pipe").is_fifo()


def test_a_folder_that_cannot_be_replaced_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = r"^\.: cannot be written: .*; choose another place or change this one$"
    with pytest.raises(NotWritable, match=message), whole_folder(Path(".")) as temporary:
        (temporary / "file").touch()
    assert list(tmp_path.iterdir()) == []


def test_text_is_utf_8(tmp_path):
    write_text(tmp_path / "file", "σ = 0.1\n")
    assert (tmp_path / "file").read_bytes() == "σ = 0.1\n".encode()


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
