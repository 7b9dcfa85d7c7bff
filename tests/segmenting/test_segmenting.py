"""What ``segment`` writes, against the fit's own segments: into HDF5, tables, LeRobot's subtasks, a page."""

import csv
import json
import re
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pyarrow.parquet as parquet
import pytest
from command_line import call, done, refused
from planted import LINEAR, small_spec
from sklearn.metrics import normalized_mutual_info_score
from time_lines import embedded, tracks, unpacked

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.importing import import_demonstrations
from ddco_pyro.data.sources import open_source
from ddco_pyro.fitting.fit import fit
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.formats.lerobot import write_subtasks
from ddco_pyro.segmenting.segments import LevelLabels, Segmented, Segments, recorded, segments
from ddco_pyro.training.data import demonstrations
from ddco_pyro.training.data import train_and_valid as split_in_parts


@pytest.fixture
def file(toy_spec, toy_run, tmp_path):
    """The toy task's demonstrations, with their labels."""
    path = tmp_path / "demos.hdf5"
    demonstrations(toy_spec).write(path)
    return path


@pytest.fixture(scope="module")
def written(toy_spec, toy_run, tmp_path_factory):
    """The toy task's demonstrations, at 20 Hz, and the places of all that one command writes of them."""
    path = tmp_path_factory.mktemp("written") / "demos.hdf5"
    demonstrations(toy_spec).write(path)
    with h5py.File(path, "r+") as opened:
        opened.attrs["control_frequency"] = 20.0
    before, time = path.read_bytes(), path.stat().st_mtime_ns
    places = {option: path.with_name(option) for option in ("--html", "--csv", "--parquet", "--out")}
    done("segment", toy_run.folder, path, *(part for pair in places.items() for part in pair))
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (before, time)
    return path, places


def look(run: Path, demos: Path) -> Segmented:
    with open_source(demos) as source:
        return segments(ddco_pyro.load(run), source)


def test_they_are_the_fits_own(toy_run, toy_spec, file, monkeypatch):
    monkeypatch.setattr("ddco_pyro.model.hierarchy.STEPS_AT_ONCE", 1)
    demos = demonstrations(toy_spec)
    (path,) = toy_run.segment(demos)
    (u,) = toy_run.posterior(demos).u
    found = look(toy_run.folder, file)
    assert [one.name for one in found.segments] == list(demos.names)
    for row, (one, demo) in enumerate(zip(found.segments, demos, strict=True)):
        level = one.levels["option"]
        np.testing.assert_array_equal(level.options, path[row])
        np.testing.assert_allclose(level.probability, u[row, np.arange(len(demo)), level.options], rtol=1e-6)
        np.testing.assert_array_equal(level.boundaries, path.starts[row])
        assert level.boundaries[0]
        assert level.boundaries[1:][np.diff(level.options) != 0].all()
        assert [option for option, a, b in level.runs() for _ in range(a, b)] == level.options.tolist()
        np.testing.assert_array_equal(one.labels["phase"], demo.labels["phase"])


NOTHING = "name what to write, such as --html PAGE or --csv FILE; labels for each step go to"
NO_DATASET = "demos.hdf5: is no LeRobot dataset, which --sarm needs; name another format, such as"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--level", "option"], NOTHING),
        (["--in-place", "--out", "copy.hdf5"], "--out and --in-place exclude each other; keep one"),
        (["--mimicgen", "copy.hdf5"], "demo_0: has no datagen_info/eef_pose"),
        (["--sarm", "copy"], NO_DATASET),
    ],
)
def test_what_to_write_has_to_be_said(toy_run, file, monkeypatch, options, message):
    monkeypatch.chdir(file.parent)
    before = file.read_bytes()
    refused(message, "segment", toy_run.folder, file, *options)
    assert [path.name for path in file.parent.iterdir()] == ["demos.hdf5"]
    assert file.read_bytes() == before


def test_labels_go_into_the_file_and_are_read_from_there(toy_run, file):
    before = Demonstrations.read(file, labels=["phase"])
    ended = call("segment", toy_run.folder, file, "--in-place")
    assert (ended.status, ended.out) == (0, f"{file}: labels/option\n")
    after = Demonstrations.read(file, labels=["phase", "option", "option_boundary"])
    for one, demo, was in zip(look(toy_run.folder, file).segments, after, before, strict=True):
        np.testing.assert_array_equal(demo.labels["option"], one.levels["option"].options)
        np.testing.assert_array_equal(demo.labels["option_boundary"], one.levels["option"].boundaries)
        np.testing.assert_array_equal(demo.labels["phase"], was.labels["phase"])
        np.testing.assert_array_equal(demo.actions, was.actions)


def test_labels_from_elsewhere_are_never_replaced(toy_run, file):
    with h5py.File(file, "r+") as opened:
        opened["data/demo_3/labels/option"] = np.zeros(len(opened["data/demo_3/actions"]), int)
    before = file.read_bytes()
    message = "demo_3: labels/option exists and was not written by ddco-pyro segment"
    refused(message, "segment", toy_run.folder, file, "--in-place")
    assert file.read_bytes() == before


def test_tables_have_a_row_for_each_step(toy_run, written):
    file, places = written
    found = look(toy_run.folder, file)
    rows = list(csv.DictReader(places["--csv"].open()))
    columns = "demonstration step seconds option option_boundary option_probability option_name"
    assert list(rows[0]) == columns.split()
    assert len(rows) == sum(len(one) for one in found.segments)
    at = 0
    for one in found.segments:
        part, level = rows[at : at + len(one)], one.levels["option"]
        assert {row["demonstration"] for row in part} == {one.name}
        assert [int(row["option"]) for row in part] == level.options.tolist()
        assert [row["option_boundary"] == "1" for row in part] == level.boundaries.tolist()
        assert [float(row["option_probability"]) for row in part] == level.probability.tolist()
        assert [float(row["seconds"]) for row in part] == [step / 20 for step in range(len(one))]
        at += len(one)
    binary = parquet.read_table(places["--parquet"]).to_pylist()
    assert [{key: str(value) for key, value in row.items()} for row in binary] == rows


# --- the page -----------------------------------------------------------------------------------------------


def test_the_page_shows_every_segment(toy_run, written):
    file, places = written
    text, found = places["--html"].read_text(), look(toy_run.folder, file)
    drawn, data = tracks(text), embedded(text)
    assert list(drawn) == [one.name for one in found.segments]
    for one, track in zip(found.segments, data["tracks"], strict=True):
        level = one.levels["option"]
        assert drawn[one.name][2]["option"] == level.runs()
        lane = track["lanes"][[lane["name"] for lane in data["lanes"]].index("option")]
        np.testing.assert_allclose(np.array(unpacked(lane["p"])) / 255, level.probability, atol=0.5001 / 255)
    assert data["lanes"][0]["names"] == list(toy_run.names["option"])
    assert "http" not in text
    assert not re.search(r"<(link|iframe|img)|src=|@import|url\(\"?http", text)


def test_intervals_are_those_of_the_posterior_draws(toy_run, file):
    """The very draws of ``Inferred.draws`` for a demonstration, and one interval for each segment."""
    with open_source(file) as source:
        known = segments(toy_run, source, intervals=True)
        assert segments(toy_run, source).segments[0].levels["option"].intervals is None
        demos = Demonstrations(tuple(recorded(known, toy_run, source)))
    (piece,) = toy_run.infer(demos)
    wide = 0
    for row, demo in enumerate(known.segments):
        level = demo.levels["option"]
        starts = np.flatnonzero(level.boundaries)
        assert level.intervals.shape == (len(starts), 2)
        assert level.intervals[0].tolist() == [0, 0]
        ((options,), (ended,)) = piece.draws(row, 100, (0, len(demo)))
        spans = zip(starts, starts[1:], [*starts[2:], len(demo)], strict=False)
        for place, (before, start, after) in enumerate(spans):
            a, b = level.options[start - 1], level.options[start]
            at = []
            for path, new in zip(options, ended, strict=True):
                pairs = [(t, path[t - 1], path[t]) for t in range(before + 1, after) if new[t] == 1]
                if steps := [t for t, left, begun in pairs if (left, begun) == (a, b)]:
                    at.append(min((abs(step - start), step) for step in steps)[1])
            low, high = level.intervals[place + 1]
            within = np.mean([low <= step <= high for step in at]) if at else 1.0
            assert within >= 0.9
            assert before < low <= high < after
            wide += high > low
    assert wide  # some boundary is uncertain


def marked(page):
    """Names on the page that are marked as held out."""
    return {name for name, (_, held_out, _) in tracks(page).items() if held_out}


def test_the_page_marks_what_was_held_out_and_says_how_labels_agree(toy_run, toy_spec, written):
    text = written[1]["--html"].read_text()
    split = split_in_parts(toy_spec, demonstrations(toy_spec))
    assert marked(text) == set(split["valid"].names)
    scores = {}
    for name, part in split.items():
        (path,) = toy_run.segment(part)
        found = np.concatenate(path)
        truth = np.concatenate([demo.labels["phase"] for demo in part])
        scores[name] = normalized_mutual_info_score(truth, found)
    assert "Agreement with the label “phase”" in text
    assert f"<td>options, 3 held out</td><td>{scores['valid']:.2f}</td>" in text
    assert f"<td>options, 9 others</td><td>{scores['train']:.2f}</td>" in text
    truth = [demo.labels["phase"] for demo in split["valid"]]
    halves = normalized_mutual_info_score(
        np.concatenate(truth), np.concatenate([np.arange(len(own)) * 2 // len(own) for own in truth])
    )
    assert f"<td>equal lengths, 3 held out</td><td>{halves:.2f}</td>" in text
    assert "Tolerances of boundary F1: ±1 step, 0.05 s; ±3 steps, 0.15 s; ±5 steps, 0.25 s." in text
    assert "3 of 12 demonstrations were held out when the run was fitted" in text


def test_the_page_escapes_what_it_shows(toy_run, tmp_path, toy_spec):
    path = tmp_path / "<img src=x>.hdf5"
    demonstrations(toy_spec).write(path)
    with h5py.File(path, "r+") as opened:
        opened.move("data/demo_0", "data/<script>alert(1)<%script>")
        for group in opened["data"].values():
            group.move("labels/phase", "labels/<b>phase")
    page = tmp_path / "segments.html"
    done("segment", toy_run.folder, path, "--html", page)
    text = page.read_text()
    assert "&lt;script&gt;alert(1)&lt;%script&gt;" in text
    assert [lane["name"] for lane in embedded(text)["lanes"]] == ["option", "<b>phase"]
    code = r'<script type="module">.*?</script>'  # the page's script, without data
    without_code = re.sub(code, "", text, flags=re.DOTALL)
    assert without_code.count("<script") == 1
    assert not re.search("<img|<b>", without_code)


# --- what cannot be segmented -------------------------------------------------------------------------------


WIDTH = "obs/offsets has shape (3,) at each step, the run was fitted to (4,)"
MISSING = "there is no observation 'offsets' (did you mean 'offset'?), which the run"


@pytest.mark.parametrize(
    ("key", "other", "width", "message"),
    [
        ("obs/offsets", "obs/offsets", 3, WIDTH),
        ("obs/offsets", "obs/offset", 4, MISSING),
        ("actions", "actions", 1, "actions has shape (1,) at each step, the run was fitted to (2,)"),
    ],
)
def test_other_demonstrations_are_refused(toy_run, file, key, other, width, message):
    with h5py.File(file, "r+") as opened:
        for group in opened["data"].values():
            steps = len(group["actions"])
            del group[key]
            group[other] = np.zeros((steps, width))
    refused(f"demo_0: {message}", "segment", toy_run.folder, file, "--in-place")


def test_a_policy_without_options_is_refused(toy_run, file):
    message = "is a flat policy without options; name a run that has options"
    refused(message, "segment", toy_run.folder / "baselines" / "flat", file, "--in-place")


# --- subtasks of LeRobot datasets ---------------------------------------------------------------------------


LEROBOT = Path(__file__).parents[1] / "fixtures" / "lerobot"
LANGUAGE = Path(__file__).parents[1] / "fixtures" / "lerobot_language"


@pytest.fixture(scope="module")
def lerobot_run(tmp_path_factory):
    """A run of two levels on the LeRobot fixture, imported."""
    folder = tmp_path_factory.mktemp("lerobot")
    import_demonstrations(LEROBOT, folder / "demos.hdf5")
    upper = {"name": "phase", "count": 2, "policy": LINEAR | {"emits": ["options", "control"]}}
    spec = small_spec(
        demonstrations={"path": str(folder / "demos.hdf5"), "valid_fraction": 0.25},
        hierarchy={"levels": [{"name": "skill", "count": 2, "policy": LINEAR}, upper], "meta_policy": LINEAR},
        training={"epochs": 2, "batch_size": 3},
    )
    return fit(spec, out=folder / "run")


def files(folder):
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def rows_of(folder):
    return parquet.read_table(next((folder / "data").rglob("*.parquet")))


def test_subtasks_are_written_as_lerobot_writes_them(tmp_path):
    """Beside what LeRobot's own annotation writer made of the same subtasks (``fixtures/README.md``).

    ``fixtures/read_formats.py`` has LeRobot read what is written here; 0.6.1 did.
    """
    options = json.loads((LANGUAGE / "options.json").read_text())
    options = {int(key): np.array(value) for key, value in options.items()}
    level = {}
    for key, value in options.items():
        level[key] = LevelLabels(value, np.ones(len(value), bool), np.ones(len(value)))
    each = (Segments(f"demo_{key}", {"skill": one}, 0.0, False) for key, one in level.items())
    found = Segmented(tuple(each), {"skill": 2}, 10.0)
    with open_source(LEROBOT) as source:
        fit = SimpleNamespace(names={"skill": ("control", "option 1", "option 2")})
        write_subtasks(Asked("--lerobot", tmp_path / "out", fit, source, "skill"), found)
    ours, theirs = rows_of(tmp_path / "out"), parquet.read_table(LANGUAGE / "data.parquet")
    assert ours.column_names == theirs.column_names
    assert ours.to_pylist() == theirs.to_pylist()
    infos = tmp_path / "out" / "meta" / "info.json", LANGUAGE / "info.json"
    ours, theirs = (json.loads(path.read_text())["features"] for path in infos)
    assert ours == theirs
    frames = parquet.ParquetFile(next((tmp_path / "out" / "data").rglob("*.parquet")))
    groups = (frames.metadata.row_group(group) for group in range(frames.num_row_groups))
    assert [group.num_rows for group in groups] == [5, 6, 7, 8]


def test_a_copy_with_subtasks(lerobot_run, tmp_path):
    out, features = tmp_path / "annotated", ("language_persistent", "language_events")
    ended = call("segment", lerobot_run.folder, LEROBOT, "--lerobot", out, "--level", "phase")
    assert (ended.status, ended.out) == (0, f"{out}\n")
    info, before = (json.loads((folder / "meta" / "info.json").read_text()) for folder in (out, LEROBOT))
    for name in features:
        assert info["features"].pop(name) == {"dtype": "language", "shape": [1], "names": None}
    assert info == before
    assert files(out) == files(LEROBOT) | {Path("meta/lerobot_annotations.json")}
    assert rows_of(out).drop_columns(list(features)).to_pylist() == rows_of(LEROBOT).to_pylist()
    with open_source(out) as source:
        assert source.names == ("demo_0", "demo_1", "demo_2", "demo_3")
    for wrong, message in (
        ([LEROBOT, "--lerobot", out], "annotated: exists; remove it, or choose another --lerobot"),
        ([out, "--lerobot", tmp_path / "twice"], "has subtasks already; name a dataset without them"),
    ):
        ended = call("segment", lerobot_run.folder, *wrong)
        assert (ended.status, ended.err.count("\n")) == (2, 1 + ended.err.count("segmenting: "))
        assert message in ended.err


def test_what_cannot_be_written_of_a_lerobot_dataset(lerobot_run, tmp_path):
    out = tmp_path / "out"
    message = "there is no level 'skil' (did you mean 'skill'?); there is: skill"
    refused(message, "segment", lerobot_run.folder, LEROBOT, "--lerobot", out, "--level", "skil")
    message = "is no HDF5 file in robomimic's layout, which --out needs; name another format"
    refused(message, "segment", lerobot_run.folder, LEROBOT, "--html", tmp_path / "page", "--out", out)
    assert not list(tmp_path.iterdir())
