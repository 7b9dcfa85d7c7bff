"""HDF5 files of which parts lie in other files or were never stored: named, refused, copied where that is allowed."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import call
from odd_files import Row
from odd_files.hdf5 import ROWS, STEPS, changed, demonstrations, last_not_whole, linked, raw, virtual

from ddco_pyro.data import memory
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.files import Damaged
from ddco_pyro.data.hdf5 import DemonstrationsError
from ddco_pyro.data.sources import open_source

ELSEWHERE = {
    "raw": (changed(raw), ["actions.raw"]),
    "link": (changed(linked, "/data/demo_0", "data/demo_1"), ["other.hdf5"]),
    "virtual": (changed(virtual), ["other.hdf5"]),
}


@pytest.mark.parametrize("kind", ELSEWHERE)
def test_other_files_are_named_and_read_only_where_that_is_allowed(kind: str, tmp_path: Path) -> None:
    make, names = ELSEWHERE[kind]
    path, out = make(tmp_path), tmp_path / "whole.hdf5"
    shown, known = call("inspect", path), json.loads(call("inspect", path, "--json").out)
    assert known["external"] == [str(tmp_path / name) for name in names]
    assert f"names another file as a part of it: {tmp_path / names[0]}\n" in shown.out
    with pytest.raises(DemonstrationsError, match="lies in another file"):
        Demonstrations.read(path)
    assert call("import", path, "--out", out).status == 2
    assert call("import", path, "--out", out, "--allow-external").status == 0
    with h5py.File(path) as file:
        truth = {key: file[f"data/demo_1/{key}"][:] for key in ("actions", "obs/offsets", "obs/visited")}
    (tmp_path / names[0]).unlink()
    (copy,) = Demonstrations.read(out).select(["demo_1"])
    np.testing.assert_array_equal(copy.actions, truth["actions"])
    for key in ("offsets", "visited"):
        np.testing.assert_array_equal(copy.observations[key], truth[f"obs/{key}"])
    assert json.loads(call("inspect", out, "--json").out)["external"] == []
    ended = call("import", path, "--out", tmp_path / "again.hdf5", "--allow-external")  # what is missing is not zero
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert "demo_1" in ended.err


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (changed(raw, STEPS * 2 * 8 - 1), r"actions.raw has to hold 192 bytes"),
        (changed(virtual, there=STEPS - 1), r"has another shape: \(11, 4\)"),
        (changed(virtual, rows=STEPS - 1), r"a part of it has no source"),
        (changed(virtual, key="y"), r"other.hdf5: x is missing"),
        (changed(virtual, "gone.hdf5"), r"gone.hdf5: there is no such file"),
    ],
)
def test_a_part_that_another_file_does_not_have(make, says: str, tmp_path: Path) -> None:
    path = make(tmp_path)
    with (
        open_source(path, external=True) as source,
        pytest.raises(DemonstrationsError, match=rf"^demo_1: (actions|obs/offsets)\b.*{says}"),
    ):
        source.recording("demo_1")


def test_labels_are_not_written_where_parts_lie_in_other_files(toy_run, tmp_path: Path) -> None:
    path = changed(linked, "/data/demo_0", "data/demo_1")(tmp_path)
    other = (tmp_path / "other.hdf5").read_bytes()
    assert call("segment", toy_run.folder, path, "--csv", tmp_path / "a.csv").status == 2
    assert call("segment", toy_run.folder, path, "--csv", tmp_path / "a.csv", "--allow-external").status == 0
    for where in (["--in-place"], ["--out", tmp_path / "out.hdf5"]):
        ended = call("segment", toy_run.folder, path, *where, "--allow-external")
        assert (ended.status, ended.err.count("\n")) == (2, 1)
        assert "labels go into whole files only; first: ddco-pyro import" in ended.err
    assert (tmp_path / "other.hdf5").read_bytes() == other


@pytest.mark.parametrize(
    "row", ["dangling demonstration", "dangling array", "a chunk missing", "1e12 rows", "a group in itself"]
)
def test_skip_broken_leaves_out_what_is_not_there(row: str, tmp_path: Path) -> None:
    odd: Row = ROWS[row]
    ended = call("import", odd.make(tmp_path), "--out", tmp_path / "out.hdf5", "--skip-broken")
    assert ended.status == 0
    assert "left out demo_1: demo_1" in ended.err
    assert Demonstrations.read(tmp_path / "out.hdf5").names == ("demo_0", "demo_2", "demo_3", "demo_4", "demo_5")


def test_nothing_is_written_before_all_headers_are_known(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    path = last_not_whole(tmp_path / "in")
    assert call("import", path, "--out", tmp_path / "out.hdf5").status == 2
    assert list(tmp_path.iterdir()) == [tmp_path / "in"]


def test_an_array_under_two_names_is_read_twice(tmp_path: Path) -> None:
    with demonstrations(tmp_path / "demos.hdf5") as file:
        for group in file["data"].values():
            group["obs/again"], group["obs/soft"] = group["obs/offsets"], h5py.SoftLink("offsets")
    first = Demonstrations.read(tmp_path / "demos.hdf5")[0].observations
    assert set(first) == {"offsets", "visited", "again", "soft"}
    np.testing.assert_array_equal(first["soft"], first["offsets"])
    np.testing.assert_array_equal(first["again"], first["offsets"])


def test_a_minari_episode_that_is_not_whole(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    from ddco_pyro.data.sources.minari import Minari

    class Storage:
        total_episodes, metadata = 2, {}

    with h5py.File(tmp_path / "main_data.hdf5", "w") as file:
        for index in range(2):
            file[f"episode_{index}/infos/one"] = 1.0
        file.create_dataset("episode_1/actions", (9, 2), "f8", chunks=(4, 2))[:4] = 1.0
    with pytest.raises(DemonstrationsError, match=r"episode_1/actions claims 144 bytes, but the file holds 64"):
        Minari(tmp_path, Storage(), False, ()).recording("demo_1")


def test_a_damaged_file_is_said_by_another_process() -> None:
    error = Damaged(Path("run/metrics.json"), "is no JSON", "remove it")
    assert str(pickle.loads(pickle.dumps(error))) == str(error) == "run/metrics.json: is damaged: is no JSON; remove it"


# --- memory -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("groups", "limits", "free"),
    [
        ("0::/job/step\n", {"job/memory.max": "3000000\n", "job/step/memory.max": "max\n"}, 3_000_000),
        ("0::/job\n", {"job/memory.max": "9000000\n", "memory.max": "max\n"}, 4_096_000),
        ("4:memory:/job\n0::/\n", {"memory/job/memory.limit_in_bytes": "2000000\n"}, 2_000_000),
        ("4:memory:/outside\n", {"memory/memory.limit_in_bytes": "1000000\n"}, 1_000_000),
        ("4:cpu:/job\n", {"memory/job/memory.limit_in_bytes": "2000000\n"}, 4_096_000),
    ],
)
def test_what_is_free(groups: str, limits: dict[str, str], free: int, tmp_path: Path) -> None:
    """A machine with 4000 kB free."""
    files = {"proc/meminfo": "MemTotal: 8000 kB\nMemAvailable:   4000 kB\n", "proc/self/cgroup": groups}
    for name, text in {**files, **{f"sys/fs/cgroup/{name}": text for name, text in limits.items()}}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert memory._free(tmp_path) == free
    shutil.rmtree(tmp_path / "proc")
    assert memory._free(tmp_path) > 1e8  # all that this machine has


def test_free_memory_decides_what_is_refused_and_no_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks are cut as if 2 GB were allowed, wherever ``DDCO_PYRO_MEMORY`` is not set."""
    monkeypatch.delenv("DDCO_PYRO_MEMORY", raising=False)
    cut = memory.share()
    for free in (1e9, 64e9):
        monkeypatch.setattr(memory, "_free", lambda free=free: free)
        assert (memory.allowed(), memory.share()) == (free, cut)
    monkeypatch.setenv("DDCO_PYRO_MEMORY", "2GB")
    assert (memory.allowed(), memory.share()) == (2e9, cut)
