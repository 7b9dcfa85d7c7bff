"""Names of options: where they come from, where they are shown, and which are refused."""

import csv
import json
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
from command_line import call, done, refused
from planted import small_spec
from time_lines import embedded

import ddco_pyro
from ddco_pyro.cli import console
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.errors import BadInput
from ddco_pyro.exporting import write_numpy
from ddco_pyro.fitting.names import accepted, matched
from ddco_pyro.metrics import NamedByLabel
from ddco_pyro.report.options import use_table
from ddco_pyro.spec import dump_spec, with_overrides

LABELLED = {"path": "demos.hdf5", "labels": "phase"}
SPEC = small_spec((3,), name="skill", demonstrations=LABELLED, observations=["place"])
PHASES = np.repeat([0, 1, 2], [6, 4, 5])


def labelled(phases=PHASES, number=4, names=None):
    """Demonstrations with a gain of their own in each phase; ``names`` goes into the file."""
    random = np.random.default_rng(0)
    places = [random.normal(size=(len(phases), 2)) for _ in range(number)]
    gains = np.array([[-3.0], [0.5], [3.0]])[np.maximum(phases, 0)]
    each = enumerate(places)
    demos = tuple(Demonstration(f"demo_{n}", {"place": p}, gains * p, {"phase": phases}) for n, p in each)
    attributes = {} if names is None else {"label_names": json.dumps({"phase": names})}
    return Demonstrations(demos, attributes=attributes)


def stands_for(choices, demos):
    return matched(SPEC, demos, (np.tile(choices, (len(demos), 1)),))


def propose(choices, demos):
    return accepted(SPEC, stands_for(choices, demos))


@pytest.mark.parametrize("order", [(1, 2, 3), (3, 1, 2)])
def test_names_follow_the_labels_in_any_order_of_options(order):
    choices = np.array(order)[PHASES]
    found = propose(choices, labelled(names=["reach", "grasp", "lift"]))["skill"]
    assert [found[order[phase] - 1] for phase in range(3)] == ["reach", "grasp", "lift"]
    found = propose(choices, labelled())["skill"]
    assert [found[order[phase] - 1] for phase in range(3)] == ["phase 0", "phase 1", "phase 2"]


def test_only_a_clear_match_gives_a_name():
    demos = labelled()
    thirds = np.array([1, 1, 2, 2, 3, 3, 2, 2, 2, 2, 3, 3, 3, 3, 3])  # label 0 lies in all three
    assert propose(thirds, demos) == {"skill": ("option 1", "phase 1", "phase 2")}
    assert propose(np.ones(15, int), demos) == {}  # label 0 has 6 of its 15 steps
    unknown = labelled(np.where(PHASES == 1, -1, PHASES))
    assert propose(np.array([3, 2, 1])[PHASES], unknown) == {"skill": ("phase 2", "option 2", "phase 0")}
    control = np.array([1, 2, 0])[PHASES]
    assert propose(control, demos) == {"skill": ("phase 0", "phase 1", "option 3")}
    twice = labelled(names=["reach", "grasp", "reach"])
    assert propose(np.array([1, 2, 3])[PHASES], twice) == {"skill": ("reach", "grasp", "option 3")}
    assert propose(np.array([1, 2, 3])[PHASES], labelled(names=["control", "", "lift"])) == {
        "skill": ("option 1", "phase 1", "lift")
    }


def test_below_an_agreement_of_three_fifths_a_name_is_proposed_and_not_given():
    demos, choices = labelled(np.repeat([0, 1, 2], [7, 5, 3]), names=["reach", "grasp", "lift"]), 1 + PHASES
    found = {one.name: one.agreement for one in stands_for(choices, demos)}
    assert found == pytest.approx({"reach": 6 / 7, "grasp": 3 / 6, "lift": 3 / 5})
    assert propose(choices, demos) == {"skill": ("reach", "option 2", "lift")}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A run that is trained from labels: option h + 1 is label h. The file names the labels."""
    folder = tmp_path_factory.mktemp("names")
    labelled(number=8, names=["reach", "grasp", "lift"]).write(folder / "demos.hdf5")
    spec = with_overrides(SPEC, {
        "demonstrations.path": str(folder / "demos.hdf5"),
        "control": {"std": 0.3},
        "compare_with": ["mixture"],
        "training": {"epochs": 60, "optimizer": {"lr": 0.1}, "labels": {"level": "skill", "from": "phase"}},
    })  # fmt: skip
    (folder / "mine.yaml").write_text(dump_spec(spec))
    ended = call("fit", folder / "mine.yaml", "--out", folder / "run", "--jobs", 1)
    assert f"names: {folder / 'run' / 'names.yaml'}: reach 1.00, grasp 1.00, lift 1.00\n" in ended.out
    return folder


def test_a_fit_proposes_the_names_of_its_labels(files):
    fit = ddco_pyro.load(files / "run")
    assert fit.names == {"skill": ("control", "reach", "grasp", "lift")}
    assert [one.agreement for one in fit.metrics.named_by_labels] == [1, 1, 1]
    assert fit.baselines["mixture"].named == {}
    own = ddco_pyro.fit(fit.spec, labelled(number=8))
    assert own.names == {"skill": ("control", "phase 0", "phase 1", "phase 2")}


def test_names_are_shown_wherever_options_are(files):
    run, demos = files / "run", files / "demos.hdf5"
    (run / "names.yaml").write_text("skill: [<go>, pick & place, 'on']\n")
    done("report", run)
    outputs = {option: files / option for option in ("--html", "--csv", "--parquet")}
    written = [part for pair in outputs.items() for part in pair]
    done("segment", run, demos, *written)
    for page in (run / "report.html", outputs["--html"]):
        text = page.read_text()
        assert "&lt;go&gt; (option 1)" in text
        skills, phases = embedded(text)["lanes"]
        assert skills["names"] == ["control", "<go>", "pick & place", "on"]
        assert (phases["name"], phases["names"]) == ("phase", {"0": "reach", "1": "grasp", "2": "lift"})
        assert "<go>" not in text
    assert re.search(r"stands for.*?>reach<.*?>grasp<.*?>lift<", (run / "report.html").read_text(), re.DOTALL)
    fit = ddco_pyro.load(run)
    truth = [fit.names["skill"][option] for row in fit.segment(fit.demonstrations)[0] for option in row]
    rows = list(csv.DictReader(outputs["--csv"].open()))
    assert [row["skill_name"] for row in rows] == truth
    assert all(fit.names["skill"][int(row["skill"])] == row["skill_name"] for row in rows)
    (row,) = (row for row in use_table(fit).rows if str(row[1]) == "pick & place (option 2)")
    text = (run / "report.html").read_text()
    number = r"pick &amp; place \(option 2\).*?Segments</dt><dd>(\d+)"
    (instances,) = re.findall(number, text, re.DOTALL)
    assert row[3:] == [instances, "4 steps", "grasp 1.00"]
    with h5py.File(demos) as file:
        place = file["data/demo_0/obs/place"][0]
    controller, monitor = fit.controller(), fit.monitor()
    controller.act({"place": place})
    assert controller.active == {"skill": fit.names["skill"][controller.choices[0]]}
    active = monitor.step({"place": place})
    assert active["skill"]["pick & place"] == pytest.approx(float(monitor.belief[0][0, 2]))
    write_numpy(fit, files)
    about = json.loads((files / "controller.json").read_text())
    assert about["names"] == {"skill": ["control", "<go>", "pick & place", "on"]}


@pytest.mark.usefixtures("undecided")
def test_a_file_with_labels_keeps_the_names_of_options_and_of_labels(files, tmp_path):
    run, out, phases = files / "run", tmp_path / "labelled.hdf5", ["reach", "grasp", "lift"]
    for names in (["go", "hold", "up"], ["go", "hold", "raise"], ["option 1", "option 2", "option 3"]):
        ddco_pyro.load(run).name_options("skill", names)
        done("segment", run, files / "demos.hdf5", "--out", out)
        named = [] if names[0] == "option 1" else ["control", *names]
        facts = {field.key: field.names for field in inspect(out).labels}
        assert facts == {"phase": phases, "skill": named, "skill_boundary": []}
    assert "0: reach, 1: grasp, 2: lift" in call("inspect", out).out
    done("init", out, "--out", tmp_path / "again.yaml")
    assert "labels: phase " in (text := (tmp_path / "again.yaml").read_text())
    assert "# labels 0, 1, ...: reach, grasp, lift\n" in text


def test_a_proposed_name_comes_with_the_line_that_takes_it(files, capsys):
    fit = ddco_pyro.load(files / "run")
    half = [NamedByLabel(level="skill", option=2, labels="phase", name="hold", agreement=0.5)]
    console.names(replace(fit, named={}, metrics=fit.metrics.model_copy(update={"named_by_labels": half})))
    said = capsys.readouterr().out
    assert "names proposed, not written: option 2 as hold 0.50" in said
    line = said.partition(f"to take them, write into {files / 'run' / 'names.yaml'}: ")[2].splitlines()[0]
    (files / "run" / "names.yaml").write_text(line)
    assert ddco_pyro.load(files / "run").names["skill"] == ("control", "option 1", "hold", "option 3")


def test_names_that_are_given_are_read_again(files):
    fit = ddco_pyro.load(files / "run")
    fit.name_options("skill", ["é", "010", "yes"])
    assert ddco_pyro.load(files / "run").names == fit.names == {"skill": ("control", "é", "010", "yes")}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("skil: [a, b, c]", "there is no level 'skil' (did you mean 'skill'?); there is: skill"),
        ("skill: [a, b]", "level 'skill': 2 names for 3 options; name each, in the order of options 1 to 3"),
        ("skill: [a, b, control]", "level 'skill': 'control' names two choices; give each a name of its own"),
        ("skill: [a, ' ', c]", "level 'skill': the name of option 2 is empty or has a line break"),
        ("skill: [a, b, 3]", "level 'skill': give a list of texts; quote a number"),
        ("- a", "is no mapping; write a line for each level, such as: option: [reach, grasp]"),
        ("skill: [a", "not valid YAML"),
    ],
)
def test_names_that_do_not_fit_are_refused(files, text, problem):
    path = files / "run" / "names.yaml"
    path.write_bytes(text.encode("latin-1"))
    ended = refused(str(path), "segment", files / "run", files / "demos.hdf5", "--csv", files / "none.csv")
    assert problem in ended.err
    assert not (files / "none.csv").exists()
    path.unlink()


def test_label_names_that_are_none_are_refused_before_anything_is_written(tmp_path):
    demos = labelled()
    wrong = Demonstrations(demos.demonstrations, attributes={"label_names": "phase"})
    with pytest.raises(BadInput, match="attribute 'label_names': is no JSON"):
        ddco_pyro.fit(SPEC, wrong, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    wrong.write(tmp_path / "wrong.hdf5")
    assert "problem: attribute 'label_names': is no JSON" in call("inspect", tmp_path / "wrong.hdf5").out
