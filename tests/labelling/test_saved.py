"""What a session of labelling saves and exports, and what is gone on with, against files read back."""

import csv
import json
import shutil
from dataclasses import replace
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from command_line import done
from labelled import accept, paint, refitted

from ddco_pyro.cli.label import _fitted
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.labels import LABEL_NAMES, UNKNOWN
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.fitted import load
from ddco_pyro.labelling.session import Session

# --- exports ------------------------------------------------------------------------------------------------

GIVEN, LEFT = range(10), range(10, 25)
"""The steps that a person gives and leaves open; others are accepted or left to the model."""


@pytest.fixture
def mixed(begin, quiet):
    """A session with two demonstrations of these steps, the first accepted."""
    session = begin()
    for index in (0, 1):
        paint(session, index, 0, 10, 3)
        paint(session, index, 10, 25, 0)
    accept(session, 0)
    refitted(session)
    return session


def sources_of(index, demos):
    return ["given"] * 10 + ["open"] * 15 + [["accepted", "proposed"][index]] * (len(demos[index]) - 25)


def test_tables_say_who_says_each_step_and_have_no_option_where_steps_are_open(mixed, demos, tmp_path):
    rows = list(csv.DictReader(mixed.export("csv", tmp_path).read_text().splitlines()))
    for index in (0, 1):
        own = [row for row in rows if row["demonstration"] == f"demo_{index}"]
        assert [row["skill_source"] for row in own] == sources_of(index, demos)
        assert {
            (own[step]["skill"], own[step]["skill_name"], own[step]["skill_probability"]) for step in LEFT
        } == {("-1", "", "0.0")}
        assert {own[step]["skill"] for step in GIVEN} == {"3"}
        assert all(int(row["skill"]) > 0 for row in own[25:])
    page = mixed.export("html", tmp_path).read_text()
    assert '"name":"skill_source","names":{"0":"open"' in page
    assert '"-1":"open"' in page


def test_other_programs_get_a_gap_where_steps_are_open_and_who_says_each_segment(mixed, demos, tmp_path):
    (tmp_path / "elan").mkdir()
    folder = mixed.export("elan", tmp_path / "elan")
    tasks = json.loads((mixed.export("label-studio", tmp_path) / "tasks.json").read_text())
    for index in (0, 1):
        root = ElementTree.parse(folder / f"demo_{index}.eaf").getroot()
        times = [(own.get("TIME_SLOT_ID"), int(own.get("TIME_VALUE"))) for own in root.iter("TIME_SLOT")]
        slots = {name: time // 1000 for name, time in times}
        tiers = {
            tier.get("TIER_ID"): {
                step: own.findtext("ANNOTATION_VALUE")
                for own in tier.iter("ALIGNABLE_ANNOTATION")
                for step in range(slots[own.get("TIME_SLOT_REF1")], slots[own.get("TIME_SLOT_REF2")])
            }
            for tier in root.iter("TIER")
        }
        assert tiers["skill"].keys() == {*GIVEN, *range(25, len(demos[index]))}
        said = {step: source for step, source in enumerate(sources_of(index, demos)) if source != "open"}
        assert tiers["skill_source"] == said
        regions = {
            step: own["meta"]["text"]
            for own in tasks[index]["predictions"][0]["result"]
            for step in range(own["value"]["start"], own["value"]["end"] + 1)
        }
        assert regions == {step: [source] for step, source in said.items()}


def test_a_saved_file_is_gone_on_with_by_anyone(mixed, begun, run, tmp_path):
    mixed.edit({"do": "rename", "option": 3, "text": "carry"})
    mixed.save()
    other = begun("mine.hdf5", shutil.copyfile(mixed.out, tmp_path / "handed_over.hdf5"))
    assert other.document.names == mixed.document.names
    for name, own in mixed.document.labels.items():
        np.testing.assert_array_equal(other.document.labels[name], own)
        np.testing.assert_array_equal(other.document.given[name], mixed.document.given[name])
    segments = tmp_path / "segments.hdf5"  # a model's proposals are nobody's labels
    done("segment", run.folder, mixed.path, "--out", segments)
    assert not begun("other.hdf5", segments).document.done


def test_labels_of_another_program_are_gone_on_with_by_their_names(begun, run, demos, tmp_path):
    """As ``import --labels`` reads them, with a name that the run does not have."""
    path, names = tmp_path / "imported.hdf5", ["let go", "carry", "close", "come", "wait"]
    truth = [np.where(np.arange(len(demo)) < 5, UNKNOWN, demo.labels["phase"]) for demo in demos]
    truth[0][-3:] = 4
    each = (replace(demo, labels={"skill": own}) for demo, own in zip(demos, truth, strict=True))
    Demonstrations(tuple(each), attributes={LABEL_NAMES: json.dumps({"skill": names})}).write(path)
    named = {"skill": ("carry", "option 2", "option 3", "option 4")}
    session = begun(path=path, fit=replace(run, named=named))
    own = session.document.names
    assert (own[0], {*own}) == ("carry", {*names})
    for name, expected in zip(demos.names, truth, strict=True):
        said = [own[label - 1] if label > 0 else "" for label in session.document.labels[name]]
        assert said == [names[value] if value >= 0 else "" for value in expected]


# --- files --------------------------------------------------------------------------------------------------


def test_saved_labels_are_read_back_with_minus_one_where_nothing_is_said(begin, demos, tmp_path):
    session, source = begin(), tmp_path / "demos.hdf5"
    content = source.read_bytes()
    paint(session, 0, 10, 20, 3)
    paint(session, 0, 12, 14, 0)
    session.edit({"do": "rename", "option": 3, "text": "carry"})
    assert session.state()["dirty"]
    session.save()
    assert not session.state()["dirty"]
    expected = np.full(len(demos[0]), -1)
    expected[10:20], expected[12:14] = 3, -1
    with h5py.File(tmp_path / "out.hdf5") as file:
        np.testing.assert_array_equal(file["data/demo_0/labels/skill"], expected)
        assert file["data/demo_0/labels/skill"].dtype.kind == "i"
        assert (file["data/demo_1/labels/skill"][:] == -1).all()
        names = json.loads(file["data"].attrs.get("label_names", file.attrs.get("label_names")))
        assert names["skill"][3] == "carry"
        assert names["phase"] == ["reach", "grasp", "carry", "release"]
    read = Demonstrations.read(tmp_path / "out.hdf5")
    np.testing.assert_array_equal(read[0].labels["skill"], expected)
    np.testing.assert_array_equal(read[0].labels["phase"], demos[0].labels["phase"])
    assert source.read_bytes() == content
    session.edit({"do": "undo"})
    session.edit({"do": "undo"})
    session.save()
    expected[10:20] = 3
    np.testing.assert_array_equal(Demonstrations.read(tmp_path / "out.hdf5")[0].labels["skill"], expected)


def test_labels_go_into_the_file_itself_again_and_again(begin, tmp_path):
    session = begin("demos.hdf5")
    for start in (0, 5):
        paint(session, 0, start, start + 5, 1)
        session.save()
        assert session.state()["warnings"] == []
    labels = Demonstrations.read(tmp_path / "demos.hdf5")[0].labels["skill"]
    assert labels[:10].tolist() == [1] * 10
    assert (labels[10:] == -1).all()


def test_a_source_that_changed_underneath_is_said_and_nothing_is_saved(begin, demos, tmp_path):
    session = begin()
    paint(session, 0, 10, 20, 3)
    session.save()
    content = (tmp_path / "out.hdf5").read_bytes()
    session.edit({"do": "undo"})
    Demonstrations(demos[:3]).write(tmp_path / "demos.hdf5")
    (warning,) = session.state()["warnings"]
    assert str(tmp_path / "demos.hdf5") in warning
    with pytest.raises(BadInput, match="changed"):
        session.save()
    assert (tmp_path / "out.hdf5").read_bytes() == content


def test_an_out_of_something_else_is_refused(begin, tmp_path):
    (tmp_path / "other.hdf5").write_text("mine")
    with pytest.raises(BadInput, match="not a labelled copy"):
        begin("other.hdf5")
    assert not list(tmp_path.glob("*.journal"))


def test_what_is_closed_is_saved_and_left_to_others(begin, tmp_path):
    session = begin()
    paint(session, 0, 10, 20, 3)
    with pytest.raises(BadInput, match="is open in a process"):
        begin()
    session.close()
    assert Demonstrations.read(tmp_path / "out.hdf5")[0].labels["skill"][10] == 3
    assert begin().state()["demos"][0]["labelled"] == 10


@pytest.mark.usefixtures("undecided")
def test_without_a_run_one_is_fitted_for_its_proposals_alone_and_used_again(demos, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    demos.write(tmp_path / "mine.hdf5")
    run = _fitted(tmp_path / "mine.hdf5")
    first = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    assert not {path.name for path in first} & {"baselines", "report.html", "figures"}
    session = Session(load(run), tmp_path / "mine.hdf5", tmp_path / "out.hdf5")
    assert sorted(session.state()["order"]) == [*range(len(demos))]
    session.close()
    assert _fitted(tmp_path / "mine.hdf5") == run
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == first
    (tmp_path / "other").mkdir()
    demos.write(tmp_path / "other" / "mine.hdf5")
    with pytest.raises(BadInput, match="copy the file under another name"):
        _fitted(tmp_path / "other" / "mine.hdf5")
