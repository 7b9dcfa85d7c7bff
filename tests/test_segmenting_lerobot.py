"""Options as subtasks of LeRobot datasets, beside what LeRobot itself writes."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.parquet as parquet
import pytest
import yaml
from command_line import call

import ddco_pyro
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.sources import open_source
from ddco_pyro.fitting.fit import fit
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments, segments
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.formats.lerobot import Annotated
from ddco_pyro.spec import parse_spec

LEROBOT = Path(__file__).parent / "fixtures" / "lerobot"
LANGUAGE = Path(__file__).parent / "fixtures" / "lerobot_language"
SPEC = """
demonstrations: {path: PATH, valid_fraction: 0.25}
observations: [state]
control: {std: 0.5}
hierarchy:
  levels:
    - {name: skill, count: 2, policy: {network: linear}}
    - {name: phase, count: 2, policy: {network: linear, emits: [options, control]}}
  meta_policy: {network: linear}
training: {epochs: 2, batch_size: 3}
"""


def look(run: Path, demos: Path) -> Segmented:
    with open_source(demos) as source:
        return segments(ddco_pyro.load(run), source)


@pytest.fixture(scope="module")
def lerobot_run(tmp_path_factory):
    """A run of two levels on the LeRobot fixture, imported."""
    folder = tmp_path_factory.mktemp("lerobot")
    import_demonstrations(LEROBOT, folder / "demos.hdf5")
    spec = parse_spec(yaml.safe_load(SPEC.replace("PATH", str(folder / "demos.hdf5"))))
    return fit(spec, out=folder / "run")


def files(folder):
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def rows_of(folder):
    return parquet.read_table(next((folder / "data").rglob("*.parquet")))


def test_subtasks_are_written_as_lerobot_writes_them(tmp_path):
    """Beside what LeRobot's own annotation writer made of the same subtasks (``fixtures/write_lerobot_language.py``).

    ``fixtures/read_formats.py`` has LeRobot read what is written here; 0.6.1 did.
    """
    options = {int(key): np.array(value) for key, value in json.loads((LANGUAGE / "options.json").read_text()).items()}
    level = {key: LevelLabels(value, np.ones(len(value), bool), np.ones(len(value))) for key, value in options.items()}
    found = Segmented(
        tuple(Segments(f"demo_{key}", {"skill": one}, 0.0, False) for key, one in level.items()), {"skill": 2}, 10.0
    )
    with open_source(LEROBOT) as source:
        fit = SimpleNamespace(names={"skill": ("control", "option 1", "option 2")})
        asked = Asked(fit, tmp_path, LEROBOT, source, "skill")  # type: ignore[arg-type]
        Annotated("--lerobot", tmp_path / "out", asked).write(found)
    ours, theirs = rows_of(tmp_path / "out"), parquet.read_table(LANGUAGE / "data.parquet")
    assert ours.column_names == theirs.column_names
    assert ours.to_pylist() == theirs.to_pylist()
    features = [
        json.loads(path.read_text())["features"] for path in (tmp_path / "out/meta/info.json", LANGUAGE / "info.json")
    ]
    assert features[0] == features[1]
    frames = parquet.ParquetFile(next((tmp_path / "out" / "data").rglob("*.parquet")))
    assert [frames.metadata.row_group(group).num_rows for group in range(frames.num_row_groups)] == [5, 6, 7, 8]


def test_subtasks_begin_at_the_very_times_of_frames(lerobot_run, tmp_path):
    """To the bit, in the frames' own type."""
    out = tmp_path / "annotated"
    assert call("segment", lerobot_run.folder, LEROBOT, "--lerobot", out).status == 0
    table = rows_of(out)
    entry = table.schema.field("language_persistent").type.value_type
    assert entry.field("timestamp").type == table.schema.field("timestamp").type == pyarrow.float32()
    for one in look(lerobot_run.folder, LEROBOT).segments:
        rows = table.filter(pyarrow.compute.equal(table["episode_index"], int(one.name[5:])))
        times, entries = rows["timestamp"].to_pylist(), rows["language_persistent"].to_pylist()
        assert all(row == entries[0] for row in entries)
        options = one.levels["skill"].options.tolist()
        active = [[said for said in entries[0] if said["timestamp"] <= time][-1] for time in times]
        assert [said["content"] for said in active] == [
            f"skill {option}" if option else "control" for option in options
        ]
        assert {said["timestamp"] for said in entries[0]} <= set(times)


def test_the_older_form_of_subtasks(lerobot_run, tmp_path):
    """``fixtures/write_lerobot.py`` says how the dataset was made; LeRobot 0.4.4 reads what is written here."""
    out = tmp_path / "annotated"
    older = ("--lerobot", out, "--level", "phase", "--lerobot-format", "0.4")
    assert call("segment", lerobot_run.folder, LEROBOT, *older).status == 0
    found = look(lerobot_run.folder, LEROBOT)
    table = rows_of(out).to_pylist()
    for one in found.segments:
        rows = [row for row in table if row["episode_index"] == int(one.name[5:])]
        assert [row["subtask_index"] for row in rows] == one.levels["phase"].options.tolist()
    names = parquet.read_table(out / "meta" / "subtasks.parquet").to_pylist()
    assert [row["subtask"] for row in names] == ["control", "phase 1", "phase 2"]
    with open_source(out) as source:  # and it can be read here again
        np.testing.assert_array_equal(
            source.recording("demo_2").labels["subtask"].array(), found.segments[2].levels["phase"].options
        )


@pytest.mark.parametrize(
    ("form", "features", "more"),
    [
        (
            "0.6",
            {"language_persistent": "language", "language_events": "language"},
            {Path("meta/lerobot_annotations.json")},
        ),
        ("0.4", {"subtask_index": "int64"}, {Path("meta/subtasks.parquet")}),
    ],
)
def test_a_copy_with_subtasks(lerobot_run, tmp_path, form, features, more):
    out = tmp_path / "annotated"
    arguments = ("segment", lerobot_run.folder, LEROBOT, "--lerobot", out, "--level", "phase", "--lerobot-format", form)
    ended = call(*arguments)
    assert (ended.status, ended.out) == (0, f"{out}\n")
    info, before = (json.loads((folder / "meta" / "info.json").read_text()) for folder in (out, LEROBOT))
    for name, dtype in features.items():
        assert info["features"].pop(name) == {"dtype": dtype, "shape": [1], "names": None}
    assert info == before
    assert files(out) == files(LEROBOT) | more
    assert rows_of(out).drop_columns(list(features)).to_pylist() == rows_of(LEROBOT).to_pylist()
    with open_source(out) as source:
        assert source.names == ("demo_0", "demo_1", "demo_2", "demo_3")
    time = (out / "meta" / "info.json").stat().st_mtime_ns
    again = call(*arguments)
    assert (again.status, again.out) == (0, f"{out}\n")
    assert (out / "meta" / "info.json").stat().st_mtime_ns == time  # it is this very copy
    other = {"0.4": "0.6", "0.6": "0.4"}[form]
    for wrong, message in (
        ([LEROBOT, "--lerobot", out, "--lerobot-format", form], "annotated: exists; choose another --lerobot"),
        ([LEROBOT, "--lerobot", out, "--level", "phase", "--lerobot-format", other], "annotated: exists"),
        ([out, "--lerobot", tmp_path / "twice"], "has subtasks already; name a dataset without them"),
        ([out, "--lerobot", tmp_path / "twice", "--lerobot-format", other], "has subtasks already; name a dataset"),
    ):
        ended = call("segment", lerobot_run.folder, *wrong)
        assert (ended.status, ended.err.count("\n")) == (2, 1 + ended.err.count("segmenting: "))
        assert message in ended.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--lerobot", "OUT", "--level", "skil"], "there is no level 'skil' (there is: skill"),
        (["--html", "OUT", "--out", "OUT2"], "labels go into HDF5 files only; name another format, such as --csv"),
    ],
)
def test_what_cannot_be_written_of_a_lerobot_dataset(lerobot_run, tmp_path, arguments, message):
    named = [one.replace("OUT", str(tmp_path / "out")) for one in arguments]
    ended = call("segment", lerobot_run.folder, LEROBOT, *named)
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert message in ended.err
    assert not list(tmp_path.iterdir())
