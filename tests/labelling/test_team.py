"""Several annotators: what is shared out, what each sees of others, and whose edits an undo takes back."""

from collections import Counter

import numpy as np
import pytest
from labelled import paint
from sklearn.metrics import cohen_kappa_score

from ddco_pyro.errors import BadInput
from ddco_pyro.labelling.team import Team

NAMES = [f"demo_{number}" for number in range(10)]


def test_every_demonstration_has_one_annotator_or_two_and_everyone_as_many():
    shares = Team("ann", ("bob", "ann", "cat"), 0.2).shares(NAMES)
    assert [*shares] == NAMES
    assert Counter(map(len, shares.values())) == {1: 8, 2: 2}
    assert all(len({*people}) == len(people) for people in shares.values())
    assert {*Counter(name for people in shares.values() for name in people).values()} == {4}
    assert Team("bob", ("ann", "bob", "cat"), 0.2).shares(NAMES) == shares


@pytest.mark.parametrize(
    "wrong", [("eve", ("ann", "bob"), 0.0), ("ann", ("ann", "ann"), 0.0), ("a/b", (), 0.0), ("ann", (), 0.5)]
)
def test_a_team_without_me_or_with_a_name_twice_is_refused(wrong):
    with pytest.raises(BadInput, match=r"--annotator|--team"):
        Team(*wrong)


@pytest.fixture
def join(begun):
    """Begins a session of an annotator, with names of skills."""
    return lambda me, skills=(), share=1.0: begun(
        f"labels_{me}.hdf5", skills=skills, team=Team(me, ("ann", "bob"), share)
    )


def test_annotators_see_each_other_agree_by_names_and_take_labels_over(join):
    ann, bob = join("ann", ["come", "close", "carry"]), join("bob", ["close", "come", "lift"])
    assert ann.state()["demos"][0]["people"] == ["ann", "bob"]
    assert ann.demo(0)["others"][0]["agreement"] is None
    paint(ann, 0, 0, 20, 1)
    paint(ann, 0, 20, 40, 2)
    paint(bob, 0, 0, 26, 2)  # come
    paint(bob, 0, 26, 36, 1)  # close
    paint(bob, 0, 36, 40, 3)  # lift, which ann does not have
    (seen,) = ann.demo(0)["others"]
    found = [(own["start"], own["stop"], seen["names"][own["option"] - 1]) for own in seen["segments"][:3]]
    assert found == [(0, 26, "come"), (26, 36, "close"), (36, 40, "lift")]
    mine, theirs = np.repeat(["come", "close"], 20), np.repeat(["come", "close", "lift"], [26, 10, 4])
    assert seen["agreement"]["kappa"] == pytest.approx(cohen_kappa_score(mine, theirs))
    assert seen["agreement"]["same"] == np.mean(mine == theirs)
    assert seen["agreement"]["boundary_f1"] == 0  # 6 steps apart
    assert ann.edit({"do": "take", "demo": 0, "annotator": "bob"})["done"]
    names = ann.document.names
    assert [names[label - 1] for label in ann.document.labels["demo_0"][:40]] == theirs.tolist()
    assert ann.demo(0)["others"][0]["agreement"] == {"kappa": 1.0, "boundary_f1": 1.0, "same": 1.0}
    ann.edit({"do": "undo"})  # of one's own edits alone
    assert (ann.document.labels["demo_0"][:40] == np.repeat([1, 2], 20)).all()
    assert (bob.document.labels["demo_0"][:40] > 0).all()
    with pytest.raises(BadInput, match="one of the annotators bob"):
        ann.edit({"do": "take", "demo": 0, "annotator": "eve"})


def test_the_journal_says_who_and_when_and_the_queue_begins_with_ones_own(join):
    session = join("ann", share=0.0)
    paint(session, 0, 0, 5, 1)
    line = session.journal.path.read_text().splitlines()[-1]
    assert '"by":"ann","at":"20' in line
    shares = [session.shares[session.demos.names[place]] for place in session.state()["order"]]
    assert shares == [("ann",)] * 3 + [("bob",)] * 3
    assert [(own["name"], own["done"], own["of"]) for own in session.state()["team"]] == [("ann", 0, 3)]
