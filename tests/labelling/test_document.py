"""The document of a person's labels and its journal, against the list of all its states."""

import resource
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import Damaged
from ddco_pyro.errors import BadInput
from ddco_pyro.labelling.document import FREE, OPEN, Document, Journal, digest

LENGTHS, NAMES = {"demo_0": 6, "demo_1": 3}, ("reach", "grasp")
QUICK = settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


@st.composite
def paints(draw):
    name = draw(st.sampled_from([*LENGTHS]))
    start = draw(st.integers(0, LENGTHS[name] - 1))
    stop, value = draw(st.integers(start + 1, LENGTHS[name])), draw(st.sampled_from([OPEN, FREE, 1, 2]))
    return ("paint", name, start, stop, value)


name = st.sampled_from([*LENGTHS])
change = st.one_of(
    paints(),
    st.tuples(st.just("cut"), name, st.integers(1, 2), st.booleans()),
    st.tuples(st.just("accept"), name, st.booleans(), st.floats(0, 9), st.integers(0, 9)),
    st.tuples(st.just("names"), st.sampled_from([NAMES, ("push", "grasp"), (*NAMES, "lift")])),
)
changes = st.lists(change, min_size=1, max_size=4)
actions = st.lists(st.one_of(changes, st.sampled_from(["undo", "redo"])), max_size=12)


def empty():
    return Document(LENGTHS, NAMES)


def said(document):
    """What a document says, in plain data."""
    labels = {name: own.tolist() for name, own in document.labels.items()}
    cuts = {name: set(own) for name, own in document.cuts.items()}
    return labels, cuts, dict(document.accepted), document.names


def act(labels, action):
    """One action of a document or a journal."""
    if isinstance(labels, Journal):
        labels.write(action)
    else:
        getattr(labels, action)() if isinstance(action, str) else labels.edit(action)


def painted(changes, labels):
    """Labels after the paints among some changes, step by step."""
    after = {name: [*own] for name, own in labels.items()}
    for kind, *of in changes:
        if kind == "paint":
            name, start, stop, option = of
            for step in range(start, stop):
                after[name][step] = option
    return after


@QUICK
@given(actions)
def test_undo_and_redo_walk_through_all_states(sequence):
    document = empty()
    past, future = [said(document)], []
    for action in sequence:
        if not {"undo": past[1:], "redo": future}.get(str(action), True):
            continue
        act(document, action)
        if action == "undo":
            future.append(past.pop())
        elif action == "redo":
            past.append(future.pop())
        else:
            assert said(document)[0] == painted(action, past[-1][0])
            past.append(said(document))
            future.clear()
        assert said(document) == past[-1]
        assert (len(document.done), len(document.undone)) == (len(past) - 1, len(future))
    for state in past[-2::-1]:
        document.undo()
        assert said(document) == state
    for state in past[1:]:
        document.redo()
        assert said(document) == state


@QUICK
@given(actions, st.data())
def test_a_journal_torn_at_any_byte_gives_the_state_after_its_whole_lines(tmp_path, sequence, data):
    path = tmp_path / "labels.journal"
    path.unlink(missing_ok=True)
    journal = Journal(path, empty(), "option")
    states = {path.stat().st_size: said(journal.document)}
    for action in sequence:
        before, size = said(journal.document), path.stat().st_size
        left = bool({"undo": journal.document.done, "redo": journal.document.undone}.get(str(action), True))
        with nullcontext() if left else pytest.raises(BadInput, match=f"nothing to {action}"):
            act(journal, action)
        assert left or (said(journal.document), path.stat().st_size) == (before, size)
        states[path.stat().st_size] = said(journal.document)
    journal.close()
    content = path.read_bytes()
    size = data.draw(st.integers(0, len(content)))
    path.write_bytes(content[:size])
    again = empty()
    journal = Journal(path, again, "option")
    whole = (states[at] for at in sorted(states, reverse=True) if at <= size)
    assert said(again) == next(whole, said(empty()))
    journal.write([("paint", "demo_1", 0, 3, 1)])  # what follows a torn line is kept whole
    journal.close()
    third = empty()
    Journal(path, third, "option").close()
    assert said(third) == said(again)


def recorded(lengths=LENGTHS, control=0.0):
    each = []
    for name, steps in lengths.items():
        each.append((name, {"place": np.zeros((steps, 1))}, np.full((steps, 2), control)))
    return Demonstrations([Demonstration(*own) for own in each])


@pytest.mark.parametrize(
    "other",
    [
        digest(recorded({**LENGTHS, "demo_1": 4}), "option"),
        digest(recorded({"demo_1": 6, "demo_0": 3}), "option"),
        digest(recorded(control=1e-9), "option"),
        digest(recorded(), "upper"),
    ],
)
def test_edits_of_something_else_are_refused_and_kept(tmp_path, other):
    path, ours = tmp_path / "labels.journal", digest(recorded(), "option")
    journal = Journal(path, empty(), ours)
    journal.write([("paint", "demo_0", 0, 6, 1)])
    journal.close()
    content = path.read_bytes()
    says = "edits of other demonstrations or of another level; give another --out"
    with pytest.raises(BadInput, match=says):
        Journal(path, empty(), other)
    assert path.read_bytes() == content
    Journal(path, empty(), ours).close()  # and left to others


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"mine", 1),
        (b"mine\nand more", 1),
        (b'{"labels":7', None),
        (b"HEADER{\n", 2),
        (b'HEADER[["paint","demo_9",0,1,1]]\n', 2),
        (b'HEADER[["accept","demo_0",true,0.0,0]]\n"undo"\n"undo"\n["torn', 4),
    ],
)
def test_a_file_that_is_no_journal_stays_as_it_is(tmp_path, content, line):
    path = tmp_path / "labels.journal"
    Journal(path, empty(), "option").close()
    content = content.replace(b"HEADER", path.read_bytes())
    path.write_bytes(content)
    if line is None:  # torn
        Journal(path, empty(), "option").close()
        return
    with pytest.raises(Damaged, match=f"line {line} is none of a journal of labels; move it away"):
        Journal(path, empty(), "option")
    assert path.read_bytes() == content


def test_an_edit_that_a_full_disk_cuts_is_not_made(tmp_path):
    """With a limit of the size of files."""
    path, document, before = tmp_path / "labels.journal", empty(), resource.getrlimit(resource.RLIMIT_FSIZE)
    journal = Journal(path, document, "option")
    content = path.read_bytes()
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) + 20, before[1]))
    try:
        with pytest.raises(OSError, match="No space left on device"):
            journal.write([("paint", "demo_0", 0, 6, 2)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == content
    assert (document.labels["demo_0"] == FREE).all()
    journal.close()
