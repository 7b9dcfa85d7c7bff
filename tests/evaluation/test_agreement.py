"""Measures of segments, against scikit-learn, counts of sets of steps, every matching, and cases by hand."""

import json
import math
from collections import Counter
from itertools import groupby, permutations

import numpy as np
import pytest
from command_line import call, done
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching
from sklearn.metrics import adjusted_rand_score, cohen_kappa_score, confusion_matrix, jaccard_score

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation import agreement as measures
from ddco_pyro.evaluation.agreement import MATCHED, UNKNOWN, UNMATCHED, boundary_distances, compare_annotators

WAYS = ("matched_globally", "matched_per_demonstration")


def agreement(segments, labels):
    found = measures.agreement(segments, labels)
    return found and found.model_dump()


def confusion(segments, labels):
    return measures.confusion(segments, labels).model_dump()


def array(text):
    """``0011`` as integers; ``.`` is not known."""
    return np.array([UNKNOWN if one == "." else int(one) for one in text])


def measured(ours, truth):
    return agreement([array(one) for one in ours.split()], [array(one) for one in truth.split()])


def noisy(seed, options=4):
    """Three demonstrations of long segments, and options that mostly follow them."""
    random = np.random.default_rng(seed)
    labels = [np.repeat(random.integers(0, 3, 8), random.integers(1, 9, 8)) for _ in range(3)]
    wrong = [np.repeat(random.integers(0, options, len(one)), 3)[: len(one)] for one in labels]
    keep = [np.repeat(random.random(len(one)) < 0.7, 3)[: len(one)] for one in labels]
    return [np.where(k, one, w) for k, one, w in zip(keep, labels, wrong, strict=True)], labels


def nmi(ours, theirs):
    """2 I(X; Y) / (H(X) + H(Y)) from counts."""
    n, joint, x, y = len(ours), Counter(zip(ours, theirs, strict=True)), Counter(ours), Counter(theirs)
    information = sum(c / n * math.log(c * n / (x[a] * y[b])) for (a, b), c in joint.items())
    entropy = [-sum(c / n * math.log(c / n) for c in counts.values()) for counts in (x, y)]
    return 2 * information / sum(entropy)


@pytest.mark.parametrize("options", [2, 5])
def test_measures_of_steps_are_those_of_scikit_learn_under_the_best_of_all_matchings(options):
    segments, labels = noisy(options, options)
    x, y = np.concatenate(segments), np.concatenate(labels)
    found = agreement(segments, labels)
    assert found["nmi"] == pytest.approx(nmi(x.tolist(), y.tolist()))
    assert found["ari"] == pytest.approx(adjusted_rand_score(y, x))
    used = max(3, options)
    names = [0, 1, 2, *range(10, 10 + options)]  # 10 and above: matched with nothing
    mapped = max((np.array(way)[x] for way in permutations(names, used)), key=lambda one: (one == y).mean())
    assert found["matched_globally"]["accuracy"] == pytest.approx((mapped == y).mean())
    jaccard = jaccard_score(y, mapped, labels=np.unique(y), average="macro")
    assert found["matched_globally"]["iou"] == pytest.approx(jaccard)
    right = sum(
        max((np.array(way)[h] == label).sum() for way in permutations(names, used))
        for h, label in zip(segments, labels, strict=True)
    )
    assert found["matched_per_demonstration"]["accuracy"] == pytest.approx(right / len(y))


def test_the_matching_is_one_for_all_demonstrations_or_one_for_each():
    """Option 5 is label 0 in the first, 1 in the second. For both, best as 1, 7 as 0: 3 + 3 of 10 steps."""
    found = measured("5555 777555", "0000 000111")
    whole, each = (found[way] for way in WAYS)
    assert whole["accuracy"] == pytest.approx(0.6)
    assert each == dict.fromkeys(MATCHED, 1.0)


def literal_f1(segments, labels, overlap):
    """Segmental F1 from sets of steps, under the matching that is given with them."""
    right, wrong, missed = 0, 0, 0
    for ours, theirs in zip(segments, labels, strict=True):
        runs = [groupby(enumerate(one), key=lambda pair: pair[1]) for one in (ours, theirs)]
        a, b = ([(key, {step for step, _ in run}) for key, run in one] for one in runs)
        free = set(range(len(b)))
        for label, steps in a:
            ratios = [len(steps & other) / len(steps | other) * (label == name) for name, other in b]
            best = max(range(len(b)), key=ratios.__getitem__)
            if ratios[best] >= overlap and best in free:
                free.remove(best)
                right += 1
            else:
                wrong += 1
        missed += len(free)
    return 2 * right / (2 * right + wrong + missed)


@pytest.mark.parametrize("seed", range(2))
def test_overlap_f1_and_boundaries_from_sets_of_steps(seed):
    segments, labels = noisy(seed)
    table = confusion(segments, labels)
    names = {
        option: 100 + option if label is None else label
        for option, label in zip(table["options"], table["matched"], strict=True)
    }
    mapped = [[names[option] for option in one] for one in segments]
    found = agreement(segments, labels)
    for percent in (10, 25, 50):
        expected = literal_f1(mapped, [one.tolist() for one in labels], percent / 100)
        assert found["matched_globally"][f"f1_{percent}"] == pytest.approx(expected)
    for tolerance in (1, 3, 5):
        pairs, total = 0, 0
        for ours, theirs in zip(segments, labels, strict=True):
            a, b = ([t for t in range(1, len(one)) if one[t] != one[t - 1]] for one in (ours, theirs))
            near = csr_array([[abs(i - j) <= tolerance for j in b] for i in a])
            pairs += (maximum_bipartite_matching(near) >= 0).sum()
            total += len(a) + len(b)
        assert found[f"boundary_f1_{tolerance}"] == pytest.approx(2 * pairs / total)


def test_edit_score_by_hand():
    """Segments A B A C for A B C: one deletion of 4. B C for A B C: one insertion of 3; the third: none."""
    found = measured("000111022222 11111222222 001122", "000111112222 00011112222 001122")
    assert found["matched_globally"]["edit"] == pytest.approx(np.mean([3 / 4, 2 / 3, 1]))


def test_steps_of_unknown_label_are_left_out():
    known = measured("0011 01", "0011 00")
    assert measured("007611 01 555", "00..11 00 ...") == known
    assert agreement([array("012")], [array("...")]) is None
    assert confusion([array("012")], [array("...")])["steps"] == []


def test_the_table_says_where_each_label_went():
    assert confusion([array("99922"), array("2220")], [array("11144"), array("4441")]) == {
        "labels": [1, 4],
        "options": [0, 2, 9],
        "steps": [[1, 0, 3], [0, 5, 0]],
        "matched": [None, 4, 1],
    }


one_of = st.lists(st.tuples(st.integers(0, 3), st.integers(-1, 2)), min_size=1, max_size=12)
demonstrations = st.lists(one_of, min_size=1, max_size=4)


def sides(pairs):
    return [[np.array([pair[side] for pair in demo]) for demo in pairs] for side in (0, 1)]


@settings(max_examples=20)
@given(demonstrations, st.permutations(range(4)), st.permutations(range(3)))
def test_names_do_not_matter(pairs, options, labels):
    segments, truth = sides(pairs)
    options = np.array(options) * 3 - 4
    labels = np.array([*labels, UNKNOWN - 5]) + 5  # -1, not known, stays what it is
    other = [np.where(one < 0, one, labels[one]) for one in truth]
    renamed = agreement([options[h] for h in segments], other)
    found = agreement(segments, truth)
    if found is None:
        assert renamed is None
        return
    for way in WAYS:
        assert renamed.pop(way) == pytest.approx(found.pop(way))
    assert renamed == pytest.approx(found)


@settings(max_examples=20)
@given(demonstrations)
def test_every_measure_is_at_most_1_which_is_perfect_and_a_matching_for_each_is_no_worse(pairs):
    segments, truth = sides(pairs)
    found = agreement(segments, truth)
    if found is not None:
        scores = [found[name] for name in UNMATCHED] + [found[way][name] for way in WAYS for name in MATCHED]
        assert max(scores) <= 1 + 1e-12
        assert min(scores) >= -1
        assert found[WAYS[1]]["accuracy"] >= found[WAYS[0]]["accuracy"]
        perfect = agreement(truth, truth)
        assert [perfect[name] for name in UNMATCHED] == pytest.approx([1] * len(UNMATCHED))
        assert [perfect[way] for way in WAYS] == [dict.fromkeys(MATCHED, 1.0)] * 2


def test_distances_are_those_of_the_best_of_all_matchings():
    """Most pairs, then the least sum, among all one-to-one matchings within the tolerance."""
    rng = np.random.default_rng(0)
    for _ in range(60):
        ours, theirs = (np.sort(rng.choice(16, rng.integers(5), replace=False)) for _ in range(2))
        short, long = sorted((ours, theirs), key=len)
        found = boundary_distances(ours, theirs, 3)
        each = [
            [abs(a - b) for a, b in zip(short, chosen, strict=True) if abs(a - b) <= 3]
            for chosen in permutations(long, len(short))
        ]
        best = min(each, key=lambda own: (-len(own), sum(own)))
        assert (len(found), found.sum()) == (len(best), sum(best))


def annotated(path, labels, names):
    """A file of demonstrations with labels/skill, a word for each step; . is unknown."""
    demos = (
        Demonstration(
            demo,
            {"x": np.zeros((len(own), 1))},
            np.zeros((len(own), 1)),
            {"skill": np.array([names.index(word) if word != "." else -1 for word in own])},
        )
        for demo, own in labels.items()
    )
    Demonstrations(tuple(demos), attributes={"label_names": json.dumps({"skill": names})}).write(path)
    return path


def test_two_annotators(tmp_path):
    """The same names under other numbers; what only one of them said counts nowhere."""
    first = {"a": "rrrrggggpp..", "b": "rrrr", "c": "rr"}
    second = {"a": "rrrggggpp.pp", "b": "rr.g", "d": "rrr"}
    a = annotated(tmp_path / "a.hdf5", first, list("rgp"))
    b = annotated(tmp_path / "b.hdf5", second, list("pgr"))
    found = compare_annotators(a, b, 1)["skill"]
    pairs = [pair for demo in "ab" for pair in zip(first[demo], second[demo], strict=True)]
    both = [pair for pair in pairs if "." not in pair]
    assert (found.demonstrations, found.steps, found.both) == (2, 16, len(both))
    assert found.same == sum(x == y for x, y in both) == 9
    assert found.kappa == pytest.approx(cohen_kappa_score(*zip(*both, strict=True)))
    assert found.names == ["r", "g", "p"]
    assert found.counts == confusion_matrix(*zip(*both, strict=True), labels=found.names).tolist()
    assert found.boundaries == (2, 2)  # at 4 and 8, and at 3 and 7; b's step 3 follows a step that is unknown
    assert found.distances == [1, 1]
    assert found.boundary_f1 == 1
    assert compare_annotators(a, b, 0)["skill"].boundary_f1 == 0
    shown = done("inspect", a, "--against", b, "--tolerance", 1)
    assert f"{found.kappa:.2f}" in shown.out
    said = json.loads(call("inspect", a, "--against", b, "--json").out)["skill"]
    assert said["counts"] == found.counts


def test_annotators_of_other_demonstrations_are_refused(tmp_path):
    a = annotated(tmp_path / "a.hdf5", {"a": "rrr"}, ["r"])
    shorter = ({"a": "rr"}, "a has 2 steps, and 3 in")
    for labels, why in (({"b": "rrr"}, "has none of the demonstrations of"), shorter):
        with pytest.raises(BadInput, match=why):
            compare_annotators(a, annotated(tmp_path / "b.hdf5", labels, ["r"]), 1)
    for missing in ((a, tmp_path / "no.hdf5"), (tmp_path / "no.hdf5", a)):
        with pytest.raises(BadInput, match=r"^[^:]*no\.hdf5: there is no such file"):
            compare_annotators(*missing, 1)
    alone = compare_annotators(a, annotated(tmp_path / "b.hdf5", {"a": "r.."}, ["r"]), 1)["skill"]
    assert (alone.both, alone.kappa, alone.boundary_f1) == (1, None, 1.0)
