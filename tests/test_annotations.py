"""Segments that other tools wrote, read as labels: files in the layouts of the tools' own sources, and round trips."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from command_line import call
from hypothesis import given, settings
from hypothesis import strategies as st

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.sources import Recording
from ddco_pyro.errors import BadInput
from ddco_pyro.names import choice_names
from ddco_pyro.segmenting import LevelLabels, Segmented, Segments
from ddco_pyro.segmenting.formats import Asked
from ddco_pyro.segmenting.formats.elan import ELAN
from ddco_pyro.segmenting.formats.label_studio import LabelStudio
from ddco_pyro.segmenting.formats.reading import Labelled

FIXTURE = Path(__file__).parent / "fixtures" / "annotations" / "demo_1.eaf"
"""pympi-ling 1.71 wrote it: a tier ``skill`` with a vocabulary, a tier ``who`` that refers to it, media from 100 ms."""


class Held:
    """A source in memory with demonstrations of these lengths."""

    format, masks, files = "robomimic", {}, ()

    def __init__(self, lengths, frequency=10.0, attributes=None):
        self._lengths, self.frequency, self.attributes = lengths, frequency, attributes or {}
        self.names = tuple(lengths)

    def recording(self, name):
        return Recording.of(name, {}, np.zeros((self._lengths[name], 2)))


def labels(source, path, rate=None):
    """Names of labels by label name, and for each demonstration the name of each step; empty where nothing is said."""
    found = Labelled(source, path, rate)
    names = json.loads(found.attributes["label_names"])
    return names, {
        demo: {
            key: [names[key][label] if label >= 0 else "" for label in column.array()]
            for key, column in found.recording(demo).labels.items()
        }
        for demo in source.names
    }


# --- round trips ------------------------------------------------------------------------------------------------------


@st.composite
def segmented(draw):
    """Segments of levels with and without names, at some frequency."""
    count = draw(st.integers(1, 4))
    words = st.lists(st.text(st.characters(codec="utf-8", categories=["L", "N", "S"]), min_size=1), unique=True)
    names = {
        level: choice_names(count, draw(words.filter(lambda own: len(own) >= count and "control" not in own))[:count])
        if draw(st.booleans())
        else choice_names(count)
        for level in ("option", "phase")[: draw(st.integers(1, 2))]
    }
    demos = [
        Segments(
            f"demo_{number}",
            {
                level: LevelLabels(options, np.diff(options, prepend=-1) != 0, np.ones(len(options)))
                for level in names
                for options in [np.array(draw(st.lists(st.integers(0, count), min_size=steps, max_size=steps)))]
            },
            0.0,
            False,
        )
        for number, steps in enumerate(draw(st.lists(st.integers(1, 12), min_size=1, max_size=2)))
    ]
    frequency = draw(st.sampled_from([None, 3.0, 10.0, 29.97, 100.0, 480.0]))
    return Segmented(tuple(demos), dict.fromkeys(names, count), frequency, names=names)


@pytest.mark.parametrize("kind", [ELAN, LabelStudio])
@settings(max_examples=15, deadline=None)
@given(planted=segmented())
def test_what_is_written_is_read_back(kind, planted):
    """Every label of every step, its number and its name."""
    source = Held({demo.name: len(demo) for demo in planted.segments}, planted.frequency)
    fit = SimpleNamespace(names=planted.names)
    with tempfile.TemporaryDirectory() as folder:
        asked = Asked(fit, Path("run"), Path("demos.hdf5"), source, next(iter(planted.names)))
        out = Path(folder) / "out"
        kind("--option", out, asked).write(planted)
        found = Labelled(source, out)
        names = json.loads(found.attributes["label_names"])
        levels = planted.names if kind is ELAN else [asked.level]
        assert list(found.recording("demo_0").labels.keys() - levels) == []
        for level in levels:
            for demo in planted.segments:
                read = found.recording(demo.name).labels[level].array()
                np.testing.assert_array_equal(read, demo.levels[level].options)
            default = ["control", *(f"{level} {option}" for option in range(1, 1 + planted.counts[level]))]
            given = list(planted.names[level])
            assert names[level] == (default if given == list(choice_names(planted.counts[level])) else given)


# --- files of the tools -----------------------------------------------------------------------------------------------


def test_elan(tmp_path):
    names, found = labels(Held({"demo_0": 3, "demo_1": 12}), FIXTURE)
    assert names == {"skill": ["grasp", "reach", "place"], "who": ["left hand"]}  # numbers of the vocabulary
    begun = ["", *["reach"] * 3, *["grasp"] * 2, "", *["place"] * 3, "", ""]
    assert found["demo_1"] == {"skill": begun, "who": [*[""] * 4, *["left hand"] * 2, *[""] * 6]}
    assert found["demo_0"] == {"skill": [""] * 3, "who": [""] * 3}


def test_times_that_elan_leaves_open_lie_evenly_between_their_neighbours(tmp_path):
    text = FIXTURE.read_text().replace(' TIME_VALUE="520"', "").replace(' TIME_VALUE="600"', "")
    (tmp_path / "demo_1.eaf").write_text(text)
    found = labels(Held({"demo_1": 120}, 100.0), tmp_path)[1]["demo_1"]["skill"]
    assert [found.index("grasp"), found.index("place")] == [40, 80]  # from 300 to 900 ms, in three
    assert found[59:61] == ["grasp", ""]


BEHAVIOURS = {
    "0": {"type": "Point event", "key": "b", "code": "beep"},
    "1": {"type": "State event", "key": "r", "code": "reach"},
    "2": {"type": "State event", "key": "g", "code": "grasp"},
}
EVENTS = [
    [5.0, "", "reach", "", "", 125], [5.4, "", "beep", "", "", 135], [5.8, "", "reach", "", "", 145],
    [5.8, "", "grasp", "hard", "", 145], [6.0, "left", "grasp", "", "", 150], [6.1, "", "grasp", "hard", "", 152],
    [6.3, "left", "grasp", "", "", 157],
]  # fmt: skip
PROJECT = {
    "project_format_version": "7.0",
    "behaviors_conf": BEHAVIOURS,
    "observations": {"demo_0": {"type": "MEDIA", "time offset": 5.0, "events": EVENTS}},
}
LOCATED = "Observation id\tTime offset (s)\tSubject\tBehavior\tModifier #1\tBehavior type"
AGGREGATED = f"""{LOCATED}\tStart (s)\tStop (s)\tDuration (s)
demo_0\t5.0\tNo focal subject\treach\t\tSTATE\t5.000\t5.800\t0.800
demo_0\t5.0\tNo focal subject\tbeep\t\tPOINT\t5.400\t5.400\tNA
demo_0\t5.0\tNo focal subject\tgrasp\thard\tSTATE\t5.800\t6.100\t0.300
demo_0\t5.0\tleft\tgrasp\t\tSTATE\t6.000\t6.300\t0.300
"""
TABULAR = f"{LOCATED}\tTime\n" + "".join(
    f"demo_0\t5.0\t{subject or 'No focal subject'}\t{code}\t{modifier}\t{kind}\t{time:.3f}\n"
    for (time, subject, code, modifier, *_), kind in zip(
        EVENTS, ["START", "POINT", "STOP", "START", "START", "STOP", "STOP"], strict=True
    )
)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("labels.boris", json.dumps(PROJECT)),
        ("labels.tsv", AGGREGATED),
        ("labels.tsv", TABULAR),
        ("labels.csv", "\ufeff" + AGGREGATED.replace("\t", ",")),
    ],
)
def test_boris(tmp_path, name, text):
    """The layouts of projects and of both exports, as BORIS 9 has them."""
    (tmp_path / name).write_text(text, encoding="utf-8")
    source = Held({"demo_0": 14, "demo_1": 2})
    names, found = labels(source, tmp_path / name)
    assert names == {"behavior": ["reach", "grasp"], "left": ["reach", "grasp"] if "boris" in name else ["grasp"]}
    assert found["demo_0"]["behavior"] == [*["reach"] * 8, *["grasp"] * 3, "", "", ""]
    assert found["demo_0"]["left"] == [*[""] * 10, *["grasp"] * 3, ""]
    assert found["demo_1"] == {"behavior": ["", ""], "left": ["", ""]}
    assert Labelled(source, tmp_path / name).notes == [
        f"{tmp_path / name}: left out 1 point events, which last no step"
    ]


def region(kind, name, tag="skill", **value):
    return {"id": "x", "from_name": tag, "to_name": "ts", "type": kind, "value": {**value, kind: [name]}}


def series(name, start, end, tag="skill"):
    return region("timeserieslabels", name, tag, start=start, end=end, instant=False)


def exported(*results, data, **task):
    each = [{"id": number, "was_cancelled": False, "result": result} for number, result in enumerate(results)]
    return {"id": 7, "data": data, "annotations": each, "predictions": [], **task}


STEPS = [series("reach", 0, 3), series("grasp", 3, 5), series("", 6, 6)]
"""Two regions that share the sample of an edge, and one that an annotator made without a label."""


@pytest.mark.parametrize(
    ("result", "said"),
    [
        (STEPS, [*["reach"] * 3, *["grasp"] * 3, "", "", ""]),
        ([series("reach", 0.1, 0.3), series("grasp", 0.4, 0.7)], ["", *["reach"] * 3, *["grasp"] * 4, ""]),
        ([region("timelinelabels", "reach", ranges=[{"start": 1, "end": 4}])], [*["reach"] * 4, *[""] * 5]),
        ([region("labels", "reach", start=0.2, end=0.6, channel=0)], ["", "", *["reach"] * 4, "", "", ""]),
        ([{"from_name": "ok", "to_name": "ts", "type": "choices", "value": {"choices": ["yes"]}}, *STEPS[:1]],
         [*["reach"] * 4, *[""] * 5]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("data", [{"demonstration": "demo_1"}, {"csv": "/data/upload/2/3f6a11c0-demo_1.csv?d=a"}])
def test_label_studio(tmp_path, result, said, data):
    """Steps, seconds, frames of a video from 1 on, and audio; a task without an annotation says nothing."""
    skipped = exported([series("reach", 0, 1)], data={"demonstration": "demo_0"})
    skipped["annotations"][0]["was_cancelled"] = True
    (tmp_path / "export.json").write_text(json.dumps([exported(result, data=data), skipped]))
    _, found = labels(Held({"demo_0": 2, "demo_1": 9}), tmp_path / "export.json")
    assert found == {"demo_0": {"skill": ["", ""]}, "demo_1": {"skill": said}}


def test_predictions_are_no_annotations(tmp_path):
    """In an export the predictions of a task that has no annotation are the model's."""
    task = exported(data={"demonstration": "demo_0"}, predictions=[{"result": [series("reach", 0, 1)]}])
    both = [task, exported([series("grasp", 0, 1)], data={"demonstration": "demo_1"})]
    (tmp_path / "export.json").write_text(json.dumps(both))
    found = labels(Held({"demo_0": 2, "demo_1": 2}), tmp_path / "export.json")[1]
    assert found == {"demo_0": {"skill": ["", ""]}, "demo_1": {"skill": ["grasp", "grasp"]}}


# --- what is refused --------------------------------------------------------------------------------------------------

NAMED = {"demonstration": "demo_1"}
LATE = {**PROJECT, "observations": {"demo_1": {"events": [[0.0, "", "reach", "", ""]]}}}


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("demo_2.eaf", FIXTURE.read_text(), "there is no demonstration 'demo_2' (did you mean 'demo_1'?)"),
        ("demo_1.eaf", FIXTURE.read_text().replace("520", "5200"),
         "demo_1: skill: grasp lasts from step 4 to 53, but there are 12 steps"),
        ("demo_1.eaf", FIXTURE.read_text().replace("520", "720"),
         "demo_1: skill: place and another segment overlap at step 7; a step has one label: end one of them"),
        ("demo_1.eaf", FIXTURE.read_text().replace("520", "310"),
         "demo_1: skill: grasp at step 4 is shorter than a step; remove or lengthen it"),
        ("demo_1.eaf", FIXTURE.read_text().replace('TIER_ID="skill"', 'TIER_ID="a/b"'), "'a/b' cannot be a name"),
        ("demo_1.eaf", FIXTURE.read_text().replace("ANNOTATION_REF", 'PREVIOUS_ANNOTATION="a1" ANNOTATION_REF'),
         "tier 'who' divides annotations of another one without times; remove it"),
        ("demo_1.eaf", FIXTURE.read_text().replace('REF="a3"', 'REF="a6"'), "or is damaged: 'a6'"),
        ("demo_1.eaf", "<a>", "cannot be read as ELAN's .eaf"),
        ("a.boris", json.dumps(LATE), "demo_1: reach at 0 s has no end; code it in BORIS"),
        ("a.boris", "{}", "cannot be read as a project of BORIS"),
        ("a.csv", "demonstration,step,option\n",
         "has no column Behavior, Behavior type, Observation id, Subject, Time; export events or aggregated events"),
        ("a.json", json.dumps([exported(STEPS, STEPS, data=NAMED)]), "task 7 has 2 annotations; leave one"),
        ("a.json", json.dumps([exported(STEPS, data={"csv": "other.csv"})]), "task 7 is of no demonstration"),
        ("a.json", json.dumps([{"id": 7, "skill": STEPS}]), "task 7 has no data: export as JSON, not as JSON-MIN"),
        ("a.json", json.dumps([exported([series("reach", 0, 3), series("grasp", 2, 5)], data=NAMED)]),
         "demo_1: skill: grasp and another segment overlap at step 2"),
        ("a.json", json.dumps([exported([], data=NAMED)]), "names no segment"),
        ("a.txt", "", "is nothing that can be read; ELAN's .eaf of a demonstration, or a folder of them; Label"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_line(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(BadInput) as refused:
        Labelled(Held({"demo_1": 12}), tmp_path / name)
    assert said in str(refused.value)
    assert name in str(refused.value)
    assert "\n" not in str(refused.value)


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def demos(tmp_path):
    """Two demonstrations whose labels were written by ``segment``, with other names, and no frequency."""
    path = tmp_path / "demos.hdf5"
    marks = {"skill": np.ones(12, int), "skill_boundary": np.ones(12, int), "phase": np.arange(12)}
    each = tuple(Demonstration(f"demo_{n}", {"x": np.zeros((12, 1))}, np.ones((12, 2)), marks) for n in range(2))
    Demonstrations(each).write(path)
    with h5py.File(path, "r+") as file:
        file.attrs["label_names"] = json.dumps({"skill": ["control", "reach"], "phase": ["a"]})
    return path


def test_labels_are_imported_beside_others(demos, tmp_path):
    out = tmp_path / "out.hdf5"
    ended = call("import", demos, "--labels", FIXTURE, "--fps", 10, "--out", out)
    assert ended.status == 0, ended.err
    assert ended.out == f"{out}: 2 demonstrations, labels/skill in 1, labels/who in 1\n"
    with h5py.File(out) as file, h5py.File(demos) as before:
        names = json.loads(file.attrs["label_names"])
        assert names == {"skill": ["control", "reach", "grasp", "place"], "phase": ["a"], "who": ["left hand"]}
        assert file.attrs["control_frequency"] == 10
        assert set(file["data/demo_1/labels"]) == {"skill", "who", "phase"}  # boundaries of other labels are gone
        np.testing.assert_array_equal(file["data/demo_1/labels/skill"], [-1, 1, 1, 1, 2, 2, -1, 3, 3, 3, -1, -1])
        np.testing.assert_array_equal(file["data/demo_0/labels/skill"], np.full(12, -1))
        np.testing.assert_array_equal(file["data/demo_0/labels/phase"], before["data/demo_0/labels/phase"])
        np.testing.assert_array_equal(file["data/demo_0/actions"], before["data/demo_0/actions"])
    assert call("import", demos, "--labels", FIXTURE, "--fps", 10, "--out", out).status == 0  # the very same
    ended = call("import", demos, "--labels", FIXTURE, "--fps", 5, "--out", out)
    assert (ended.status, ended.err) == (2, f"ddco-pyro: {out}: is there already and is not this import; choose "
                                            "another --out\n")  # fmt: skip


def test_steps_without_a_frequency_are_seconds(demos, tmp_path):
    ended = call("import", demos, "--labels", FIXTURE, "--out", tmp_path / "out.hdf5")
    assert ended.status == 2
    assert ended.err == (
        f"ddco-pyro: --labels {FIXTURE}: demo_1: skill: reach at step 0 is shorter than a step; remove or lengthen it; "
        "without --fps a step is one second\n"
    )
    assert call("import", demos, "--fps", 10, "--out", tmp_path / "out.hdf5").status == 2


def test_a_missing_file_of_segments_is_the_one_that_is_named(demos, tmp_path):
    for name in ("no.eaf", "no.txt"):
        ended = call("import", demos, "--labels", tmp_path / name, "--out", tmp_path / "out.hdf5")
        assert (ended.status, ended.err.count("\n")) == (2, 1)
        assert ended.err.startswith(f"ddco-pyro: --labels {tmp_path / name}: is missing")
