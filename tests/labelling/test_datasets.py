"""A LeRobot dataset is labelled as it is, and labels are read back by this project and by LeRobot itself."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
from labelled import paint
from planted import small_spec

from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.sources import open_source
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fit import fit
from ddco_pyro.labelling.team import Team

HERE = Path(__file__).parents[1]
TOOLS = Path(os.environ.get("DDCO_PYRO_TOOLS", HERE.parent / ".venv-tools")) / "bin" / "python"


@pytest.fixture
def dataset(tmp_path):
    return Path(shutil.copytree(HERE / "fixtures" / "lerobot", tmp_path / "dataset"))


@pytest.fixture
def begin(dataset, tmp_path, begun):
    """Begins a session with the dataset."""
    import_demonstrations(dataset, tmp_path / "numbers.hdf5")
    known = {"path": str(tmp_path / "numbers.hdf5"), "valid_fraction": 0}
    training = {"epochs": 3, "optimizer": {"name": "em"}, "tune_fraction": 0}
    run = fit(small_spec(demonstrations=known, training=training), out=tmp_path / "run")
    return lambda out, me="ann": begun(out, dataset, run, skills=["reach", "lift"], team=Team(me))


def labelled(session):
    """Labels with a gap in the first episode, open steps in the second, and a third that is left out."""
    for stretch in ((0, 0, 2, 1), (0, 3, 5, 2), (1, 0, 3, 0), (1, 3, 6, 2)):
        paint(session, *stretch)
    session.edit({"do": "mark", "demo": 2, "mark": "exclude", "value": True})
    session.edit({"do": "mark", "demo": 2, "mark": "note", "value": "dropped it"})
    session.save()


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_cameras_names_of_joints_and_the_task_are_those_of_the_dataset(begin, tmp_path):
    demo = begin(tmp_path / "out").demo(0)
    assert (demo["cameras"], demo["task"]) == (["images/wrist", "images/top"], "pull the block")
    assert {*demo["numbers"]["names"]} == {"state x", "state y", "state grip", "control vx", "control vy"}


def test_a_copy_has_the_labels_in_its_language_with_source_and_annotator(begin, dataset, tmp_path):
    before = contents(dataset)
    session = begin(tmp_path / "out")
    labelled(session)
    assert not session.state()["dirty"]
    assert contents(dataset) == before
    rows = parquet.read_table(next((tmp_path / "out" / "data").rglob("*.parquet"))).to_pylist()
    first = [(own["content"], round(own["timestamp"], 1)) for own in rows[0]["language_persistent"]]
    assert first == [("reach", 0.0), (None, 0.2), ("lift", 0.3)]  # no content: a gap
    assert [row["subtask_source"] for row in rows[:11]] == [3, 3, 1, 3, 3, 0, 0, 0, 3, 3, 3]
    assert [row["subtask_annotator"] for row in rows[:5]] == ["ann", "ann", "", "ann", "ann"]
    with open_source(tmp_path / "out") as source:
        labels = [source.read(name).labels["subtask"].tolist() for name in source.names[:2]]
        assert source.masks == {"exclude": ("demo_2",)}
        assert source.read("demo_2").attributes["note"] == "dropped it"
    assert labels == [[0, 0, -1, 1, 1], [-1, -1, -1, 1, 1, 1]]
    table = session.export("csv", tmp_path).read_text()
    assert ("demo_3" in table, "demo_2" in table) == (True, False)


def test_in_place_keeps_videos_and_what_links_lead_to_and_anyone_goes_on_with_the_labels(begin, dataset):
    for name in ("data", "meta"):
        (dataset / name).rename(dataset.with_name(name))
        (dataset / name).symlink_to(dataset.with_name(name))
    linked = [contents(dataset.with_name(name)) for name in ("data", "meta")]
    videos = [path.stat().st_ino for path in dataset.rglob("*.mp4")]
    session = begin(dataset)
    labelled(session)
    assert [contents(dataset.with_name(name)) for name in ("data", "meta")] == linked
    assert [path.stat().st_ino for path in dataset.rglob("*.mp4")] == videos
    assert session.state()["warnings"] == []
    session.journal.close()
    session.journal.path.unlink()
    other = begin(dataset, me="bob")
    for name, own in session.document.labels.items():
        np.testing.assert_array_equal(other.document.labels[name], own)
    assert (other.document.names, other.document.marks) == (session.document.names, session.document.marks)


def test_a_folder_of_something_else_is_refused(begin, tmp_path):
    (tmp_path / "mine").mkdir()
    with pytest.raises(BadInput, match="is not a labelled copy of"):
        begin(tmp_path / "mine")


READ = """
import json, sys
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language_render import active_at
dataset = LeRobotDataset("ddco/labelled", root=sys.argv[1], video_backend="pyav")
for frame in map(dataset.__getitem__, range(11)):
    rows, now = frame["language_persistent"], float(frame["timestamp"])
    active = active_at(now, persistent=rows, style="subtask", role="assistant")
    said = [active and active["content"], int(frame["subtask_source"]), frame["subtask_annotator"]]
    print(json.dumps(said))
"""


@pytest.mark.slow
@pytest.mark.skipif(not TOOLS.exists(), reason="LeRobot is not installed: make tools")
def test_lerobot_reads_the_subtask_of_each_frame(begin, tmp_path):
    labelled(begin(tmp_path / "out"))
    command, offline = [str(TOOLS), "-c", READ, str(tmp_path / "out")], {**os.environ, "HF_HUB_OFFLINE": "1"}
    read = subprocess.run(command, capture_output=True, text=True, check=True, env=offline).stdout
    found = [json.loads(line) for line in read.splitlines() if line.startswith("[")]
    assert [own[0] for own in found] == ["reach"] * 2 + [None] + ["lift"] * 2 + [None] * 3 + ["lift"] * 3
    assert [own[1:] for own in found[:3]] == [[3, "ann"], [3, "ann"], [1, ""]]
