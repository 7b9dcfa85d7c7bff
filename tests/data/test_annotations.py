"""Segments in tables, read as labels: the columns are those that ELAN, BORIS and Label Studio export."""

import json

import h5py
import numpy as np
import pandas as pd
import pytest
from command_line import done, refused

from ddco_pyro.data.annotations import LabelTable
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.importing import Choice, import_demonstrations
from ddco_pyro.errors import BadInput


def labels(lengths, path, known=None, **said):
    """Names of labels by label name; names of each step by demonstration, empty where nothing is said; notes.

    :param lengths: steps of each demonstration by its name.
    :param known: the names of labels that the source has.
    """
    source, out = path.with_name("source.hdf5"), path.with_name("labelled.hdf5")
    each = (Demonstration(name, {"x": np.zeros((n, 1))}, np.zeros((n, 2))) for name, n in lengths.items())
    attributes = {"control_frequency": 10.0, "label_names": json.dumps(known or {})}
    Demonstrations(tuple(each), attributes=attributes).write(source)
    notes = import_demonstrations(source, out, choice=Choice(labels=LabelTable(path, **said))).notes
    demos = Demonstrations.read(out)
    names = json.loads(demos.attributes["label_names"])
    found = {}
    for demo in demos:
        each = demo.labels.items()
        found[demo.name] = {key: [names[key][at] if at >= 0 else "" for at in own] for key, own in each}
    return names, found, list(notes)


ROWS = [
    ("demo_1", "reach", 0.1, 0.4),
    ("demo_1", "grasp", 0.4, 0.6),
    ("demo_1", "", 0.7, 0.8),
    ("demo_0", "reach", 0, 0.2),
]
STEPS = ["", *["reach"] * 3, *["grasp"] * 2, "", ""]


@pytest.mark.parametrize(
    ("kind", "names", "scale", "said"),
    [
        ("a.csv", ("start_s", "stop_s"), 1, {}),
        ("a.tsv", ("Start (ms)", "Stop (ms)"), 1000, {}),
        ("a.txt", ("first frame", "last_step"), 10, {}),
        ("a.parquet", ("from", "to"), 10, {"unit": "steps"}),
        ("a.csv", ("from", "to"), 2, {"unit": "seconds", "rate": 5.0}),
    ],
)
def test_any_table(tmp_path, kind, names, scale, said):
    """A label is called as its column; steps of which nothing is said, segments of no label, are unknown."""
    table = pd.DataFrame(ROWS, columns=["episode", "skill", *names])
    table[list(names)] *= scale
    path = tmp_path / kind
    if kind == "a.parquet":
        table.to_parquet(path)
    else:
        separator = {"a.csv": ",", "a.tsv": "\t", "a.txt": ";"}[kind]
        table.to_csv(path, sep=separator, index=False, encoding="utf-8-sig")
    columns = dict(zip(("demonstration", "label", "start", "stop"), table, strict=True))
    found = labels({"demo_0": 3, "demo_1": 8}, path, columns=columns, **said)
    assert found == (
        {"skill": ["reach", "grasp"]},
        {"demo_1": {"skill": STEPS}, "demo_0": {"skill": ["reach", "reach", ""]}},
        [],
    )


def test_labels_that_differ_by_case_or_blanks_alone_are_one(tmp_path):
    """They have the source's name, or the commonest; and it is said."""
    names = ["Grasp", "grasp ", "grasp", "grasp", "Pick Up", "pickup", "PLACE"]
    table = pd.DataFrame({"demonstration": "demo_0", "label": names, "start": range(7), "stop": range(1, 8)})
    table.to_csv(tmp_path / "a.csv", index=False)
    source = {"label": ["control", "place"]}
    known, found, notes = labels({"demo_0": 7}, tmp_path / "a.csv", source, unit="steps")
    assert known == {"label": ["control", "place", "grasp", "Pick Up"]}
    assert found["demo_0"]["label"] == ["grasp"] * 4 + ["Pick Up"] * 2 + ["place"]
    assert notes == [
        "labels/label: read 'Grasp' as 'grasp', 'grasp ' as 'grasp', 'pickup' as 'Pick Up', 'PLACE' as "
        "'place', since case or blanks alone differ"
    ]


ELAN = """Begin Time - hh:mm:ss.ms\tBegin Time - ss.msec\tBegin Time - msec\tEnd Time - hh:mm:ss.ms\t\
End Time - ss.msec\tEnd Time - msec\tDuration - hh:mm:ss.ms\tDuration - ss.msec\tDuration - msec\t\
skill\twho\tFile Name\tFile Path
00:00:00.100\t0.1\t100\t00:00:00.400\t0.4\t400\t00:00:00.300\t0.3\t300\treach\t\tdemo_1.eaf\tfile:///a
00:00:00.400\t0.4\t400\t00:00:00.600\t0.6\t600\t00:00:00.200\t0.2\t200\tgrasp\tleft hand\tdemo_1.eaf\tfile:///a
"""


def test_elan(tmp_path):
    """Tab-delimited text of multiple files: a column for each tier, and times in several formats."""
    (tmp_path / "elan.txt").write_text(ELAN)
    names, found, notes = labels({"demo_0": 3, "demo_1": 8}, tmp_path / "elan.txt")
    assert (names, notes) == ({"skill": ["reach", "grasp"], "who": ["left hand"]}, [])
    assert found["demo_1"] == {"skill": STEPS, "who": [*[""] * 4, *["left hand"] * 2, "", ""]}
    assert found["demo_0"] == {"skill": [""] * 3, "who": [""] * 3}


LOCATED = "Observation id\tTime offset (s)\tSubject\tBehavior\tBehavioral category\tModifier #1\t"
LOCATED += "Behavior type"
AGGREGATED = f"""{LOCATED}\tStart (s)\tStop (s)\tDuration (s)
demo_0\t5.0\tNo focal subject\treach\t\t\tSTATE\t5.000\t5.800\t0.800
demo_0\t5.0\tNo focal subject\tbeep\t\t\tPOINT\t5.400\t5.400\tNA
demo_0\t5.0\tNo focal subject\tgrasp\t\thard\tSTATE\t5.800\t6.100\t0.300
demo_0\t5.0\tleft\tgrasp\t\t\tSTATE\t6.000\t6.300\t0.300
"""


@pytest.mark.parametrize(
    ("name", "text"), [("a.tsv", AGGREGATED), ("a.csv", "\ufeff" + AGGREGATED.replace("\t", ","))]
)
def test_boris(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    names, found, notes = labels({"demo_0": 14, "demo_1": 2}, tmp_path / name)
    assert names == {"behavior": ["reach", "grasp"], "left": ["grasp"]}
    assert found["demo_0"]["behavior"] == [*["reach"] * 8, *["grasp"] * 3, "", "", ""]
    assert found["demo_0"]["left"] == [*[""] * 10, *["grasp"] * 3, ""]
    assert found["demo_1"] == {"behavior": ["", ""], "left": ["", ""]}
    assert notes == [
        "left out 1 point events, which last no step",
        "left out the modifiers of 1 rows: a label is a behavior alone",
    ]


EVENTS = [  # of BORIS' tabular events: behavior, modifier, what it is, time
    ("reach", "", "STOP", 5.2),
    ("reach", "slow", "START", 5.3),
    ("beep", "", "POINT", 5.4),
    ("reach", "", "STOP", 5.8),
    ("grasp", "", "START", 5.8),
    ("grasp", "", "STOP", 6.1),
    ("grasp", "", "START", 6.1),
    ("grasp", "", "START", 6.2),
    ("grasp", "", "STOP", 6.3),
    ("lift", "", "START", 6.4),
]


@pytest.mark.parametrize("kind", ["Behavior type", "Status"])
def test_boris_events_are_pairs_by_behavior(tmp_path, kind):
    """Events without a partner are named and lose nothing else. Another demonstration has the same events."""
    each = [(f"demo_{n}", "5", "No focal subject", *event) for event in EVENTS for n in (0, 1)]
    columns = ["Observation id", "Time offset (s)", "Subject", "Behavior", "Modifier #1", kind, "Time"]
    pd.DataFrame(each, columns=columns).to_csv(tmp_path / "a.csv", index=False)
    names, found, notes = labels({"demo_0": 16, "demo_1": 14}, tmp_path / "a.csv")
    assert names == {"behavior": ["reach", "grasp"]}
    for name, steps in (("demo_0", 16), ("demo_1", 14)):
        expected = ["", "", "", *["reach"] * 5, *["grasp"] * 3, "", "grasp", *[""] * 3][:steps]
        assert found[name]["behavior"] == expected
    assert notes == [
        "left out events without a partner (6): demo_0: reach STOP at 5.2, demo_1: reach STOP at 5.2, "
        "demo_0: grasp START at 6.1, ...",
        "left out 2 point events, which last no step",
        "left out the modifiers of 2 rows: a label is a behavior alone",
    ]


def series(name, start, end):
    return {"start": start, "end": end, "instant": False, "timeserieslabels": [name] if name else []}


def exported(*tasks, key="demonstration", tag="label"):
    """A CSV of Label Studio, from (the demonstration, its regions)."""
    rows = [
        {"id": n, key: demo, "series": '{"step": [0, 1]}', tag: json.dumps(regions) if regions else "",
         "annotator": 1, "annotation_id": 3 + n, "created_at": "", "updated_at": "", "lead_time": 9.1}
        for n, (demo, regions) in enumerate(tasks)
    ]  # fmt: skip
    return pd.DataFrame(rows).to_csv(index=False)


REGIONS = [series("reach", 0, 3), series("grasp", 3, 5), series("", 6, 6)]
"""Two regions that share the sample of an edge, and one that an annotator made without a label."""


RANGES = [{"ranges": [{"start": 1, "end": 4}], "timelinelabels": ["reach"]}]
SERIES = [series("reach", 0.1, 0.3), series("grasp", 0.4, 0.7)]


@pytest.mark.parametrize(
    ("regions", "unit", "said"),
    [
        (REGIONS, "steps", [*["reach"] * 3, *["grasp"] * 3, "", "", ""]),
        (SERIES, "seconds", ["", *["reach"] * 3, *["grasp"] * 4, ""]),
        (RANGES, "steps", [*["reach"] * 4, *[""] * 5]),
        ([{"start": 0.2, "end": 0.6, "labels": ["reach"]}], "seconds", ["", "", *["reach"] * 4, *[""] * 3]),
    ],
)
def test_label_studio(tmp_path, regions, unit, said):
    """Time series with inclusive ends, frames of a video from 1 on, and audio; a task may have no region."""
    uploaded = "/data/upload/2/3f6a11c0-demo_1.csv?d=a"
    (tmp_path / "a.csv").write_text(exported((uploaded, regions), ("demo_0", []), key="csv"))
    asked = {"unit": unit, "columns": {"demonstration": "csv"}}
    found = labels({"demo_0": 2, "demo_1": 9}, tmp_path / "a.csv", **asked)
    assert found[1] == {"demo_0": {"label": ["", ""]}, "demo_1": {"label": said}}


def plain(*rows, start="start_s", stop="stop_s"):
    return pd.DataFrame(rows, columns=["demonstration", "label", start, stop]).to_csv(index=False)


COLUMNS = {"columns": {"start": "start_s", "stop": "stop_s"}}
REACH = ("demo_1", "reach", 0.1, 0.4)


@pytest.mark.parametrize(
    ("text", "more", "said"),
    [
        (plain(("demo_2", "reach", 0, 1)), COLUMNS,
         "there is no demonstration 'demo_2' (did you mean 'demo_1'?)"),
        (plain(REACH, ("demo_1", "grasp", 0.4, 5.3)), COLUMNS,
         "demo_1: label: grasp lasts from step 4 to 53, but there are 12 steps; correct it, the unit or "
         "--fps"),
        (plain(("demo_1", "place", 0.3, 0.8), REACH), COLUMNS,
         "demo_1: label: place and another segment overlap at step 3; a step has one label: end one of them"),
        (plain(("demo_1", "grasp", 0.4, 0.41)), COLUMNS,
         "grasp at step 4 is shorter than a step; remove or lengthen"),
        (plain(("demo_1", "grasp", 0.4, "00:01")), COLUMNS,
         "row 1: the stop '00:01' is no number; correct it"),
        (plain(("demo_1", "", 0, 1)), COLUMNS, "names no segment"),
        ("Observation id,Subject,Behavior,Behavior type,Time\ndemo_1,,reach,STOP,0.4\n", {},
         "names no segment; left out events without a partner (1): demo_1: reach STOP at 0.4"),
        (plain(REACH), {},
         "its columns are demonstration, label, start_s, stop_s; say what they are with --columns "
         "start=COLUMN,stop=COLUMN"),
        (plain(REACH), {"columns": {"label": "skil"}},
         "has no column 'skil'; there is: demonstration, label, start_s"),
        (plain(REACH, start="start", stop="stop"), {},
         "does not say the unit of its times; add --unit seconds, mill"),
        (plain(REACH, stop="stop_ms"), {"columns": {"start": "start_s", "stop": "stop_ms"}},
         "does not say the unit of its times"),
        (exported(("demo_1", REGIONS)), {}, "does not say the unit of its times"),
        (exported(("demo_1", REGIONS), tag="a/b"), {"unit": "steps"}, "'a/b' cannot be a name of labels"),
        (exported(("demo_1", [series("reach", 0, 3), series("grasp", 2, 5)])), {"unit": "steps"},
         "demo_1: label: grasp and another segment overlap at step 2"),
        (exported(("demo_1", REGIONS), key="csv"), {},
         "say what they are with --columns demonstration=COLUMN"),
        (exported(("demo_1", [{"labels": ["a", "b"], "start": 0, "end": 1}])), {},
         "has 2 labels; a step has one"),
        (exported(("demo_1", [{"labels": ["a"]}])), {}, "is no table as its tool exports it, or is damaged"),
        ("", {}, "cannot be read as a table, or is damaged"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_line(tmp_path, text, more, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(BadInput) as refused:
        labels({"demo_1": 12}, tmp_path / "a.csv", **more)
    assert said in str(refused.value)
    assert str(refused.value).startswith(f"--labels {tmp_path / 'a.csv'}: ")
    assert "\n" not in str(refused.value)


@pytest.fixture
def demos(tmp_path):
    """Two demonstrations whose labels were written by ``segment``, with other names, and no frequency."""
    path = tmp_path / "demos.hdf5"
    marks = {"skill": np.ones(12, int), "skill_boundary": np.ones(12, int), "phase": np.arange(12)}
    x, controls = np.zeros((12, 1)), np.ones((12, 2))
    each = tuple(Demonstration(f"demo_{n}", {"x": x}, controls, marks) for n in range(2))
    Demonstrations(each).write(path)
    with h5py.File(path, "r+") as file:
        file.attrs["label_names"] = json.dumps({"skill": ["control", "reach"], "phase": ["a"]})
    return path


def test_labels_are_imported_beside_others(demos, tmp_path):
    out, table = tmp_path / "out.hdf5", tmp_path / "elan.txt"
    table.write_text(ELAN)
    ended = done("import", demos, "--labels", table, "--fps", 10, "--out", out)
    assert ended.out == f"{out}: 2 demonstrations, labels/skill in 1, labels/who in 1\n"
    with h5py.File(out) as file, h5py.File(demos) as before:
        names = json.loads(file.attrs["label_names"])
        assert names == {"skill": ["control", "reach", "grasp"], "phase": ["a"], "who": ["left hand"]}
        assert file.attrs["control_frequency"] == 10
        # boundaries of other labels are gone
        assert set(file["data/demo_1/labels"]) == {"skill", "who", "phase"}
        np.testing.assert_array_equal(file["data/demo_1/labels/skill"], [-1, 1, 1, 1, 2, 2, *[-1] * 6])
        np.testing.assert_array_equal(file["data/demo_0/labels/skill"], np.full(12, -1))
        np.testing.assert_array_equal(file["data/demo_0/labels/phase"], before["data/demo_0/labels/phase"])
        np.testing.assert_array_equal(file["data/demo_0/actions"], before["data/demo_0/actions"])


def test_columns_and_the_unit_are_said(demos, tmp_path):
    (tmp_path / "a.csv").write_text("episode,what,from,to\ndemo_1,Reach,2,4\ndemo_1,lift,4,5\n")
    asked = ("import", demos, "--labels", tmp_path / "a.csv", "--out", tmp_path / "out.hdf5")
    columns = ("--columns", "demonstration=episode,label=what,start=from,stop=to")
    ended = done(*asked, *columns, "--unit", "steps")
    assert ended.out == f"{tmp_path / 'out.hdf5'}: 2 demonstrations, labels/what in 1\n"
    with h5py.File(tmp_path / "out.hdf5") as file:
        assert json.loads(file.attrs["label_names"])["what"] == ["Reach", "lift"]
        assert file["data/demo_1/labels/what"][:6].tolist() == [-1, -1, 0, 0, 1, -1]
    (tmp_path / "out.hdf5").unlink()
    unclear = "--columns demo=episode: write demonstration=COLUMN,label=COLUMN,start=COLUMN"
    for more, said in (
        ([*columns, "--unit", "seconds"], "the demonstrations do not say how long a step is; add --fps"),
        (["--columns", "demo=episode"], unclear),
        (columns, "does not say the unit of its times; add --unit seconds, milliseconds or steps"),
    ):
        refused(said, *asked, *more)
    refused("--fps", "import", demos, "--fps", 10, "--out", tmp_path / "out.hdf5")
    assert not (tmp_path / "out.hdf5").exists()


def test_a_missing_table_is_the_file_that_is_named(demos, tmp_path):
    (tmp_path / "folder").mkdir()
    for path, said in (
        (tmp_path / "no.csv", "is missing"),
        (tmp_path / "folder", "is a folder; give a table: CSV, TSV or Parquet"),
    ):
        asked = ("import", demos, "--labels", path, "--out", tmp_path / "out.hdf5")
        refused(f": --labels {path}: {said}\n", *asked)
