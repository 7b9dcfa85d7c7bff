"""A session of labelling: what is shown, changed and proposed anew, against the fit and the planted truth."""

import csv
import json
import threading

import numpy as np
import pytest
from labelled import accept, here, label, refitted, stretches
from time_lines import unpacked

from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.data.inspection import inspect
from ddco_pyro.data.starting import starting_spec
from ddco_pyro.errors import BadInput
from ddco_pyro.labelling.background import Background
from ddco_pyro.labelling.document import FREE, OPEN
from ddco_pyro.labelling.proposals import USUAL, Proposals

COUNT, NAMES = 4, ("let go", "carry", "close", "come")


def shown(session):
    """Where segments begin, and the option and who says so, of each step of every demonstration."""
    refitted(session)
    found = []
    for own in session.state()["demos"]:
        starts, options, said = zip(*own["strip"], strict=True)
        steps = np.searchsorted(starts, np.arange(own["steps"]), side="right") - 1
        found.append(([*starts], [(options[step], said[step]) for step in steps]))
    return found


def by_step(segments):
    """The option and who says so, of each step."""
    return [(own["option"], own["source"]) for own in segments for _ in range(own["start"], own["stop"])]


# --- what is shown ------------------------------------------------------------------------------------------


def test_before_any_label_the_fit_proposes(begin, run, demos):
    session = begin()
    state, (paths,), (u,) = session.state(), run.segment(demos), run.posterior(demos).u
    wrong = []
    for index, path in enumerate(paths):
        found = session.demo(index)
        assert by_step(found["segments"]) == [(option, "proposed") for option in path.tolist()]
        probability = u[index].numpy()[np.arange(len(path)), path]
        expected = np.rint(255 * np.minimum(probability, 1))
        np.testing.assert_array_equal(unpacked(found["probability"]), expected)
        wrong.append((1 - probability + USUAL * probability).sum())
        assert [own["step"] for own in found["boundaries"]] == (np.flatnonzero(np.diff(path)) + 1).tolist()
        for own in found["boundaries"]:
            assert own["low"] <= own["step"] <= own["high"]
            density = unpacked(own["density"])
            assert (len(density), max(density)) == (own["high"] - own["low"] + 1, 255)
    assert [own["expected_wrong"] for own in state["demos"]] == pytest.approx(wrong, abs=0.006)
    assert state["summary"] == {"expected_wrong": None, "one_more": None, "labelled": 0}
    assert [own["steps"] for own in state["demos"]] == [*demos.lengths]
    assert sorted(state["order"]) == [*range(len(demos))]
    assert (state["can_undo"], state["can_redo"], state["dirty"]) == (False, False, False)


# --- commands -----------------------------------------------------------------------------------------------

paint = {"do": "paint", "demo": 0, "start": 10, "stop": 20, "option": 3}
SAID = np.repeat([1, 3, 2, 4], [10, 10, 10, 18])


SPLIT = {"do": "split", "demo": 0, "step": 15}


@pytest.mark.parametrize(
    ("commands", "labels"),
    [
        ([{**paint, "start": 12, "stop": 14, "option": 0}], {(12, 14): OPEN}),
        ([{"do": "name", "demo": 0, "step": 15, "option": 1}], {(10, 20): 1}),
        ([{"do": "open", "demo": 0, "step": 19}], {(10, 20): OPEN}),
        ([{"do": "merge", "demo": 0, "step": 10}], {(10, 30): 3}),
        ([{"do": "move", "demo": 0, "boundary": 20, "to": 25}], {(10, 25): 3}),
        ([{"do": "move", "demo": 0, "boundary": 20, "to": 15}], {(15, 30): 2}),
        ([SPLIT, {"do": "name", "demo": 0, "step": 15, "option": 4}], {(15, 20): 4}),
        ([SPLIT, {"do": "merge", "demo": 0, "step": 12}], {}),
        ([{"do": "open", "demo": 0, "step": 19}, {"do": "undo"}, {"do": "redo"}], {(10, 20): OPEN}),
    ],
    ids=lambda value: "-".join(own["do"] for own in value) if isinstance(value, list) else "",
)
def test_a_command_changes_these_labels(begin, commands, labels):
    session = begin()
    label(session, 0, SAID - 1)
    for command in commands:
        assert session.edit(command)["demo"] in (0, None)
    expected = SAID.copy()
    for (start, stop), option in labels.items():
        expected[start:stop] = option
    np.testing.assert_array_equal(session.document.labels["demo_0"], expected)
    for (option, source), own in zip(shown(session)[0][1], expected, strict=True):
        assert source == "open" if own == OPEN else (option, source) == (own, "given")


def test_a_boundary_that_is_moved_is_pinned_on_both_sides(begin):
    session = begin()
    left, right = session.demo(0)["segments"][:2]
    to = left["stop"] + 3
    session.edit({"do": "move", "demo": 0, "boundary": left["stop"], "to": to})
    labels = session.document.labels["demo_0"]
    assert labels[left["stop"] - 1 : to + 1].tolist() == [left["option"]] * 4 + [right["option"]]
    assert (labels > 0).sum() == 5
    moved = session.demo(0)["segments"]
    assert [(own["option"], own["stop"]) for own in moved[:2]] == [
        (left["option"], to),
        (right["option"], right["stop"]),
    ]


def test_everywhere_names_all_segments_of_an_option(begin):
    session = begin()
    before = [steps for _, steps in shown(session)]
    option = before[0][0][0]
    other = option % COUNT + 1
    session.edit({"do": "everywhere", "demo": 0, "step": 0, "option": other})
    for steps, (_, now) in zip(before, shown(session), strict=True):
        assert all(now[step][0] == other for step, (own, _) in enumerate(steps) if own == option)
    for steps, labels in zip(before, session.document.labels.values(), strict=True):
        assert labels.tolist() == [other if own == option else FREE for own, _ in steps]
    session.edit({"do": "undo"})
    assert [steps for _, steps in shown(session)] == before


@pytest.mark.usefixtures("quiet")
def test_accepting_says_what_is_seen_except_what_is_open(begin):
    session = begin()
    session.edit({"do": "paint", "demo": 1, "start": 0, "stop": 2, "option": 3})
    session.edit({"do": "paint", "demo": 1, "start": 4, "stop": 8, "option": 0})
    before = by_step(session.demo(1)["segments"])
    accept(session, 1)
    refitted(session)
    labels, state = session.document.labels["demo_1"], session.state()
    assert labels[4:8].tolist() == [OPEN] * 4
    expected = [option for step, (option, _) in enumerate(before) if not 4 <= step < 8]
    assert labels[[*range(4), *range(8, len(labels))]].tolist() == expected
    assert (state["demos"][1]["accepted"], state["summary"]["labelled"], state["order"][-1]) == (True, 1, 1)
    sources = [source for _, source in by_step(session.demo(1)["segments"])]
    assert sources == ["given"] * 2 + ["accepted"] * 2 + ["open"] * 4 + ["accepted"] * (len(labels) - 8)
    before = session.journal.path.read_bytes()
    assert not accept(session, 1)["done"], "what is accepted stays so"
    assert session.journal.path.read_bytes() == before
    session.edit({"do": "reopen", "demo": 1})
    assert not session.document.accepted
    seen = [[0, 1], [20, 2]]  # whatever is shown meanwhile
    session.edit({"do": "accept", "demo": 0, "segments": seen})
    labels = session.document.labels["demo_0"].tolist()
    assert labels == [1] * 20 + [2] * (len(labels) - 20)


@pytest.mark.usefixtures("quiet")
def test_open_steps_are_one_segment_which_has_boundaries_at_its_ends_alone(begin):
    session = begin()
    session.edit({"do": "split", "demo": 0, "step": 20})
    session.edit({"do": "paint", "demo": 0, "start": 8, "stop": 30, "option": 0})
    refitted(session)
    demo = session.demo(0)
    (own,) = [own for own in demo["segments"] if own["start"] < 30 and own["stop"] > 8]
    assert (own["start"], own["stop"], own["option"], own["source"]) == (8, 30, 0, "open")
    assert not [own for own in demo["boundaries"] if 8 < own["step"] < 30]
    with pytest.raises(BadInput, match="is open; name it first"):
        session.edit({"do": "split", "demo": 0, "step": 12})
    session.edit({"do": "move", "demo": 0, "boundary": 30, "to": 28})
    session.edit({"do": "move", "demo": 0, "boundary": 8, "to": 10})
    assert np.flatnonzero(session.document.labels["demo_0"] == OPEN).tolist() == [*range(10, 28)]


@pytest.mark.usefixtures("quiet")
def test_a_dropped_option_is_another_one_or_none_everywhere_and_an_undo_brings_it_back(begin):
    session = begin()
    label(session, 0, SAID - 1)
    for option, text in enumerate(NAMES, start=1):
        session.edit({"do": "rename", "option": option, "text": text})
    before = [steps for _, steps in shown(session)]
    session.edit({"do": "drop", "option": 3, "into": 1})
    assert session.document.names == ("let go", "carry", "come")
    np.testing.assert_array_equal(session.document.labels["demo_0"], np.array([0, 1, 2, 1, 3])[SAID])
    assert {option for _, steps in shown(session) for option, _ in steps} <= {1, 2, 3}
    session.edit({"do": "undo"})
    assert session.document.names == NAMES
    np.testing.assert_array_equal(session.document.labels["demo_0"], SAID)
    assert shown(session)[0][1] == before[0]
    session.edit({"do": "drop", "option": 4})  # none everywhere
    assert (session.document.labels["demo_0"][30:] == FREE).all()
    assert {option for _, steps in shown(session) for option, _ in steps} <= {1, 2, 3}
    with pytest.raises(BadInput, match="refit before you write segments"):
        session.export("csv", session.out.parent)


@pytest.mark.usefixtures("quiet")
def test_names_that_go_on_from_a_step_are_one_edit_a_segment(begin, demos):
    session, truth = begin(), demos[0].labels["phase"]
    shown_first = session.demo(0)["segments"][0]
    assert not session.state()["scratch"]
    session.edit({"do": "name", "demo": 0, "step": 0, "option": shown_first["option"] % COUNT + 1})
    assert session.state()["scratch"]  # what was named was proposed wrong
    session.edit({"do": "undo"})
    segments, last = stretches(truth), len(truth) - 5
    for start, _, option in segments:
        session.edit({"do": "name", "demo": 0, "step": start, "option": option, "from_here": True})
    session.edit({"do": "open", "demo": 0, "step": last, "from_here": True})
    assert len(session.document.done) == len(segments) + 1
    np.testing.assert_array_equal(session.document.labels["demo_0"], [*truth[:last] + 1, *[OPEN] * 5])


@pytest.mark.usefixtures("quiet")
def test_names_that_go_on_leave_alone_what_a_person_said(begin, demos):
    session, steps = begin(), len(demos[0])
    session.edit({"do": "paint", "demo": 0, "start": steps - 4, "stop": steps - 2, "option": 2})
    session.edit({"do": "name", "demo": 0, "step": 3, "option": 1, "from_here": True})
    expected = [FREE] * 3 + [1] * (steps - 7) + [2] * 2 + [FREE] * 2
    np.testing.assert_array_equal(session.document.labels["demo_0"], expected)


def test_skills_are_named_at_the_start_and_coloured(begun):
    session = begun(skills=[*NAMES, "wait"])
    assert session.state()["names"] == [*NAMES, "wait"]
    session.edit({"do": "colour", "option": 5, "colour": "#123456"})
    session.edit({"do": "rename", "option": 5, "text": "idle"})
    assert session.state()["colours"][4] == "#123456"
    session.edit({"do": "undo"})
    assert session.state()["colours"][4] == "#123456"


@pytest.mark.usefixtures("quiet")
def test_an_excluded_demonstration_is_last_and_in_no_export_and_in_a_mask(begin, demos, tmp_path):
    session = begin()
    first = session.state()["order"][0]
    name = demos.names[first]
    for mark, value in (("exclude", True), ("flag", True), ("note", "slipped")):
        session.edit({"do": "mark", "demo": first, "mark": mark, "value": value})
    session.edit({**paint, "demo": (first + 1) % 5})
    refitted(session)
    assert session.state()["order"][-1] == first
    assert session.state()["demos"][first]["marks"] == {"exclude": True, "flag": True, "note": "slipped"}
    assert name not in session.export("csv", tmp_path).read_text()
    session.save()
    saved = Demonstrations.read(session.out)
    assert saved.masks["exclude"] == (name,)
    assert saved[first].attributes["note"] == "slipped"
    text = starting_spec(inspect(session.out), session.out).text
    assert name in text.partition("exclude:")[2].partition("\n")[0]
    session.edit({"do": "mark", "demo": first, "mark": "exclude", "value": False})
    session.save()
    assert "exclude" not in Demonstrations.read(session.out).masks


def test_what_changes_nothing_is_no_edit(begin):
    session = begin()
    commands = [paint, {"do": "rename", "option": 1, "text": "come"}, {**paint, "demo": 1, "option": 0}]
    assert all(session.edit(command)["done"] for command in commands)
    content = session.journal.path.read_bytes()
    named = {"do": "name", "demo": 0, "step": 12, "option": 3}
    again = [*commands, named, {"do": "open", "demo": 1, "step": 12}]
    assert not any(session.edit(command)["done"] for command in [*again, {"do": "reopen", "demo": 0}])
    assert session.journal.path.read_bytes() == content


def test_an_edit_waits_for_no_other_demonstration(begin, demos, monkeypatch):
    """Other demonstrations follow the newest edit."""
    session, go_on, learned, learn = begin(), threading.Event(), [], Proposals.learn
    before = right(session, demos, range(2, 5))

    def late(proposals, labels):
        learned.append(sum((own > 0).sum() for own in labels.values()))
        assert go_on.wait(20)
        return learn(proposals, labels)

    monkeypatch.setattr(Proposals, "learn", late)
    for index in (0, 1):
        label(session, index, COUNT - 1 - demos[index].labels["phase"])
        own = session.demo(index)["segments"]
        assert by_step(own) == [(COUNT - phase, "given") for phase in demos[index].labels["phase"].tolist()]
    assert session.progress()["behind"]
    go_on.set()
    refitted(session)
    assert learned[-1] == len(demos[0]) + len(demos[1])
    assert right(session, demos, range(2, 5)) > before


@pytest.mark.parametrize(
    "command",
    [
        {"do": "fly"},
        {"do": "paint", "demo": 0},
        {"do": "paint", "demo": 99, "start": 0, "stop": 5, "option": 1},
        {"do": "paint", "demo": 0, "start": 5, "stop": 5, "option": 1},
        {"do": "paint", "demo": 0, "start": 0, "stop": 5, "option": 99},
        {"do": "name", "demo": 0, "step": -1, "option": 1},
        {"do": "split", "demo": 0, "step": 0},
        {"do": "move", "demo": 0, "boundary": 1, "to": 2},
        {"do": "new", "text": "two\nlines"},
        {"do": "rename", "option": 1, "text": "option 2"},
        {"do": "undo"},
        {"do": "drop", "option": 1, "into": 1},
        {"do": "colour", "option": 1, "colour": "red"},
        {"do": "mark", "demo": 0, "mark": "note", "value": True},
        {"do": "take", "demo": 0, "annotator": "eve"},
        {"do": "accept", "demo": 0},
        {"do": "accept", "demo": 0, "segments": [[1, 1]]},
        {"do": "accept", "demo": 0, "segments": [[0, 9]]},
    ],
    ids=json.dumps,
)
def test_a_command_that_cannot_be_done_is_one_line_and_changes_nothing(begun, command):
    session = begun()
    before, content = shown(session), session.journal.path.read_bytes()
    with pytest.raises(BadInput) as error:
        session.edit(command)
    assert "\n" not in str(error.value)
    assert (shown(session), session.journal.path.read_bytes()) == (before, content)


# --- refits -------------------------------------------------------------------------------------------------


def right(session, demos, rest):
    """The share of right steps of these demonstrations, where options are labelled in the opposite order."""
    pairs = [(shown(session)[index][1], demos[index].labels["phase"]) for index in rest]
    each = [one for steps, own in pairs for one in zip(steps, own, strict=True)]
    return np.mean([option == COUNT - truth for (option, _), truth in each])


def test_two_labelled_demonstrations_label_the_others_and_exports_have_the_names(begin, demos, tmp_path):
    session = begin()
    before = right(session, demos, range(2, 5))
    for index in (0, 1):
        label(session, index, COUNT - 1 - demos[index].labels["phase"])
    at_once = right(session, demos, range(2, 5))
    for option, text in enumerate(NAMES, start=1):
        session.edit({"do": "rename", "option": option, "text": text})
    session.refit()
    assert (refitted(session)["done"], refitted(session)["error"]) == (1, "")
    assert before < at_once
    assert right(session, demos, range(2, 5)) > 0.95
    assert right(session, demos, (0, 1)) == 1
    expected = [[NAMES[option - 1] for option, _ in steps] for _, steps in shown(session)]
    assert set(expected[4]) == {*NAMES}
    assert by_csv(session.export("csv", tmp_path), demos.names) == expected


def test_expected_wrong_steps_follow_from_accepted_demonstrations(begin, demos):
    session, found = begin(), []
    for index in (0, 1):
        if index:  # the first is accepted as it is proposed
            session.edit({**paint, "demo": index, "start": 0, "stop": len(demos[index]), "option": 1})
        accept(session, index)
        refitted(session)
        found.append(session.sure)
    assert found[0] < USUAL < found[1]
    state, steps = session.state(), sum(len(demo) for demo in demos)
    left = [own["expected_wrong"] for own in state["demos"]]
    assert state["summary"]["expected_wrong"] == pytest.approx(sum(left) / steps, abs=0.001)
    assert state["summary"]["one_more"] == pytest.approx(left[state["order"][0]] / steps, abs=0.001)


def by_csv(file, names):
    """The name at each step of each demonstration, in a table."""
    rows = list(csv.DictReader(file.read_text().splitlines()))
    return [[row["skill_name"] for row in rows if row["demonstration"] == name] for name in names]


def test_a_new_option_such_as_none_is_proposed_after_a_refit(begin, demos):
    session = begin()
    session.edit({"do": "new", "text": "none"})
    for index in (0, 1, 2):
        truth = np.where(demos[index].labels["phase"] == 1, 4, demos[index].labels["phase"])
        label(session, index, truth)  # option 2 has no steps
    accept(session, 0)
    assert refitted(session)["error"] == ""
    grasped = [
        option == 5
        for (_, steps), demo in zip(shown(session)[3:], demos[3:], strict=True)
        for (option, _), phase in zip(steps, demo.labels["phase"], strict=True)
        if phase == 1
    ]
    assert np.mean(grasped) > 0.8


def test_without_labels_there_is_no_refit(begin):
    with pytest.raises(BadInput, match="nothing is labelled"):
        begin().refit()


@pytest.mark.usefixtures("quiet")
def test_after_a_kill_the_refit_is_made_again_and_what_the_file_lacks_can_be_saved(begin, monkeypatch):
    session = begin()
    session.edit(paint)
    accept(session, 0)
    session.journal.close()  # as a kill does
    monkeypatch.undo()
    monkeypatch.setattr(Background, "_submit", here)
    again = begin()
    assert again.state()["dirty"]
    again.begin()
    assert (refitted(again)["done"], again.document.accepted.keys()) == (1, {"demo_0"})
    again.save()
    again.journal.close()
    third = begin()
    assert not third.state()["dirty"]
    third.edit({"do": "undo"})
    third.journal.close()
    assert begin().state()["dirty"]
