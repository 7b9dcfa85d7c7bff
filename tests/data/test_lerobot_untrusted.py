"""LeRobot datasets that lie: nothing outside them is read or written, and nothing absent is made up."""

import json
import re
from pathlib import Path

import pytest
from command_line import call, done
from odd_files import lerobot as odd
from odd_files import snapshot
from planted import small_spec

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.errors import DemonstrationsError
from ddco_pyro.data.importing import Choice, import_demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.fitting.fit import fit


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    import_demonstrations(odd.FIXTURE, folder / "demos.hdf5")
    known = {"path": str(folder / "demos.hdf5"), "valid_fraction": 0.25}
    return fit(small_spec(demonstrations=known, training={"epochs": 1}), out=folder / "run").folder


def refused(ended, message: str) -> None:
    lines = [line for line in ended.err.splitlines() if not line.startswith(("segmenting: ", "importing: "))]
    assert (ended.status, len(lines)) == (2, 1), ended
    assert re.search(message, lines[0]), lines[0]


@pytest.mark.parametrize("name", odd.PATHS)
def test_what_leads_out_is_refused_and_nothing_is_touched(name: str, tmp_path: Path, run: Path) -> None:
    row = odd.ROWS[name]
    dataset = row.make(tmp_path)
    before = snapshot(tmp_path)
    for command in (
        ("inspect", dataset),
        ("import", dataset, "--out", tmp_path / "demos.hdf5"),
        ("segment", run, dataset, "--lerobot", tmp_path / "annotated"),
    ):
        refused(call(*command), row.says)
        assert snapshot(tmp_path) == before


def test_the_hubs_cache_is_read_and_copied(tmp_path: Path, run: Path) -> None:
    """There the files of a dataset are links into the folder ``blobs``."""
    hub = tmp_path / "datasets--ddco--fixture"
    (hub / "snapshots").mkdir(parents=True)
    dataset = odd.changed()(hub / "snapshots")
    (hub / "blobs").mkdir()
    for number, path in enumerate(path for path in sorted(dataset.rglob("*")) if path.is_file()):
        path.rename(hub / "blobs" / str(number))
        path.symlink_to(hub / "blobs" / str(number))
    (dataset / "loop").symlink_to(dataset)
    before = snapshot(tmp_path)
    done("import", dataset, "--out", tmp_path / "demos.hdf5")
    assert Demonstrations.read(tmp_path / "demos.hdf5").lengths == (5, 6, 7, 8)
    out = tmp_path / "annotated"
    done("segment", run, dataset, "--lerobot", out)
    assert not any(path.is_symlink() for path in out.rglob("*"))
    assert (out / odd.VIDEO).read_bytes() == (odd.FIXTURE / odd.VIDEO).read_bytes()
    assert before.items() <= snapshot(tmp_path).items()


@pytest.mark.parametrize("name", odd.EPISODES_NOT_WHOLE)
def test_an_episode_that_is_not_whole_is_named_and_can_be_skipped(name: str, tmp_path: Path) -> None:
    make, message = odd.EPISODES_NOT_WHOLE[name]
    dataset = make(tmp_path)
    out = tmp_path / "demos.hdf5"
    refused(call("import", dataset, "--out", out), message)
    assert not out.exists()
    (problem,) = [line for line in inspect(dataset).problems if "cannot be used in" not in line]
    assert re.search(message, problem), problem
    ended = call("import", dataset, "--out", out, "--skip-broken")
    assert (ended.status, ended.err.count("left out demo_")) == (0, 1)
    assert len(Demonstrations.read(out)) == 3


GAP = [*range(7), *range(8, 27)]
FEW = "demo_2: .* has 1 frames from second 1.1 on, and 7 are needed"
NO_FRAME = "demo_1: .* has no frame of step 2: the next one is at second 0.8"


@pytest.mark.parametrize(
    ("times", "message", "broken"),
    [(range(12), FEW, ["demo_2", "demo_3"]), (GAP, NO_FRAME, ["demo_1"])],
)
def test_episodes_without_all_of_their_frames_are_named(times, message: str, broken, tmp_path: Path) -> None:
    dataset = odd.changed(odd.video_of(*times))(tmp_path)
    with pytest.raises(DemonstrationsError, match=message):
        import_demonstrations(dataset, tmp_path / "demos.hdf5", choice=Choice(("images/top",)))
    choice = Choice(("images/top",), skip_broken=True)
    left_out = import_demonstrations(dataset, tmp_path / "demos.hdf5", choice=choice).left_out
    kept = {*Demonstrations.read(tmp_path / "demos.hdf5").names}
    assert left_out.keys() | kept == {f"demo_{n}" for n in range(4)}
    assert [*left_out] == broken


def test_rows_of_an_episode_that_is_not_named_are_not_annotated(tmp_path: Path, run: Path) -> None:
    dataset = odd.changed(
        odd.rewritten(odd.EPISODES, lambda table: table.slice(0, 3)), odd.info(total_episodes=3)
    )(tmp_path)
    ended = call("segment", run, dataset, "--lerobot", tmp_path / "annotated")
    refused(ended, "rows of episode 3 that meta/episodes does not name")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset"]


def test_data_need_not_lie_under_data(tmp_path: Path, run: Path) -> None:
    dataset = odd.changed(odd.info(data_path="steps/{episode_index}-{file_index:03d}.parquet"))(tmp_path)
    (dataset / "steps").mkdir()
    table = odd.parquet.read_table(dataset / odd.DATA)
    for index in range(4):
        odd.parquet.write_table(odd.of_episode(table, index), dataset / "steps" / f"{index}-000.parquet")
    out = tmp_path / "annotated"
    done("segment", run, dataset, "--lerobot", out)
    columns = odd.parquet.read_table(out / "steps" / "2-000.parquet").column_names
    assert "language_persistent" in columns
    assert "language_persistent" in json.loads((out / "meta" / "info.json").read_text())["features"]
