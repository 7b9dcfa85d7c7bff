"""HDF5 files of which parts are elsewhere or were never stored: refused, with the command that mends them."""

import re
import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import done, refused
from odd_files import Row
from odd_files.hdf5 import ROWS

from ddco_pyro.data import arrays
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.errors import DemonstrationsError


@pytest.mark.parametrize("kind", ["external storage", "virtual", "external link to a demonstration"])
def test_parts_elsewhere_are_refused(kind: str, tmp_path: Path, toy_run) -> None:
    odd = ROWS[kind]
    path = odd.make(tmp_path)
    with pytest.raises(DemonstrationsError, match=odd.says):
        Demonstrations.read(path)
    ended = refused("", "segment", toy_run.folder, path, "--in-place")
    assert re.search(odd.says, ended.err)
    repack = shutil.which("h5repack")
    if repack and "link" not in kind:
        subprocess.run([repack, "--merge", "-l", "CONTI", path, tmp_path / "whole.hdf5"], check=True)
        with h5py.File(path) as file:
            truth = file["data/demo_1/actions"][:], file["data/demo_1/obs/offsets"][:]
        (copy,) = Demonstrations.read(tmp_path / "whole.hdf5").select(["demo_1"])
        np.testing.assert_array_equal(copy.actions, truth[0])
        np.testing.assert_array_equal(copy.observations["offsets"], truth[1])


@pytest.mark.parametrize(
    "row", ["dangling link", "external link to an array", "a chunk missing", "1e12 rows", "a group in itself"]
)
def test_skip_broken_leaves_out_what_is_not_there(row: str, tmp_path: Path) -> None:
    odd: Row = ROWS[row]
    ended = done("import", odd.make(tmp_path), "--out", tmp_path / "out.hdf5", "--skip-broken")
    assert "left out demo_1: demo_1" in ended.err
    kept = ("demo_0", "demo_2", "demo_3", "demo_4", "demo_5")
    assert Demonstrations.read(tmp_path / "out.hdf5").names == kept


@pytest.mark.parametrize(
    ("groups", "limits", "free"),
    [
        ("0::/job/step\n", {"job/memory.max": "3000000\n", "job/step/memory.max": "max\n"}, 3_000_000),
        ("0::/job\n", {"job/memory.max": "9000000\n", "memory.max": "max\n"}, 4_096_000),
        ("0::/\n", {}, 4_096_000),
    ],
)
def test_what_is_free(groups: str, limits: dict[str, str], free: int, tmp_path: Path) -> None:
    """A machine with 4000 kB free."""
    files = {"proc/meminfo": "MemTotal: 8000 kB\nMemAvailable:   4000 kB\n", "proc/self/cgroup": groups}
    for name, text in {**files, **{f"sys/fs/cgroup/{name}": text for name, text in limits.items()}}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert arrays.free(tmp_path) == free
    shutil.rmtree(tmp_path / "proc")
    assert arrays.free(tmp_path) > 1e8  # all that this machine has
