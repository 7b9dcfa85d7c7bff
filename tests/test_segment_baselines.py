"""Baselines that segment, on planted structure, and against the packages' own models."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.errors import BadInput
from ddco_pyro.evaluation.agreement import agreement
from ddco_pyro.segmenting.baselines import BASELINES, segment
from ddco_pyro.spec import ObservationSpec

CENTRES = np.array([[-2.0, 0.0], [2.0, 0.0], [0.0, 3.0]])


def planted(number=10, seed=0, noise=0.3):
    """Three kinds of steps in an order of their own, at three places in units that differ; the gripper (control 1)
    is closed in the second kind alone. ``place`` says where in one unit, control 0 in another.
    """
    random = np.random.default_rng(seed)
    demos = []
    for index in range(number):
        kind = np.repeat(random.permutation(3), random.integers(6, 12, 3))
        seen = CENTRES[kind] + noise * random.normal(size=(len(kind), 2))
        controls = np.stack([seen[:, 0] / 50, np.where(kind == 1, 1.0, 0.0)], axis=1)
        demos.append(Demonstration(f"demo_{index}", {"place": 1000 * seen}, controls, {"kind": kind}))
    return Demonstrations(tuple(demos))


def scores(name, valid, **settings):
    found = segment(name, planted(), valid, 3, 0, **settings)
    return agreement(found, [demo.labels["kind"] for demo in valid])


@pytest.mark.parametrize("name", ["kmeans", "gmm", "hmm", "change_points"])
def test_kinds_that_lie_apart_are_found_in_demonstrations_not_seen(name):
    found = scores(name, planted(4, seed=1))
    assert found.matched_globally.accuracy > 0.97
    assert found.boundary_f1_1 > 0.97


def test_time_tells_apart_what_a_step_alone_does_not():
    """With much noise a hidden Markov model and change points use the steps around; the gripper is left out."""
    train, noisy = (
        Demonstrations(tuple(Demonstration(d.name, d.observations, d.actions[:, :1], d.labels) for d in demos))
        for demos in (planted(30, noise=1.0), planted(10, seed=1, noise=1.0))
    )
    truth = [demo.labels["kind"] for demo in noisy]
    nmi = {name: agreement(segment(name, train, noisy, 3, 0), truth).nmi for name in BASELINES}
    assert min(nmi["hmm"], nmi["change_points"]) > nmi["kmeans"] + 0.1


def test_equal_lengths():
    (found,) = segment("equal", planted(), planted(1).select(["demo_0"]), 4, 0)
    sizes = np.bincount(found)
    assert len(sizes) == 4
    assert sizes.max() - sizes.min() <= 1
    assert (np.diff(found) >= 0).all()
    short = Demonstrations((Demonstration("demo_0", {"place": np.zeros((2, 2))}, np.zeros((2, 2))),))
    assert segment("equal", planted(), short, 4, 0)[0].tolist() == [0, 2]


def test_gripper_changes():
    closed = [[0, 0, 1, 1, 1, 0, 1], [1, 1, 0, 0, 0, 0, 0]]
    demos = [
        Demonstration(f"demo_{n}", {"place": np.zeros((7, 1))}, np.stack([np.linspace(-1, 1, 7), one], 1))
        for n, one in enumerate(closed)
    ]
    valid = Demonstrations(tuple(demos))
    found = segment("gripper", planted(), valid, 2, 0)
    assert [one.tolist() for one in found] == [[0, 0, 1, 1, 1, 2, 3], [0, 0, 1, 1, 1, 1, 1]]
    assert segment("gripper", valid, valid, 2, 0, gripper=0)[0].tolist() == [0, 0, 0, 0, 1, 1, 1]
    with pytest.raises(BadInput, match="there is no control dimension 2; there are 2"):
        segment("gripper", valid, valid, 2, 0, gripper=2)


@pytest.mark.parametrize("name", BASELINES)
def test_it_is_what_the_seed_says_and_looks_at_observations_alone_that_are_named(name):
    train, valid = planted(), planted(3, seed=1)
    random = np.random.default_rng(3)
    more = [
        Demonstrations(
            tuple(
                Demonstration(d.name, {**d.observations, "noise": random.normal(size=(len(d), 4))}, d.actions)
                for d in one
            )
        )
        for one in (train, valid)
    ]
    named = segment(name, *more, 3, 5, observations=[ObservationSpec(key="place")])
    for one, other in zip(segment(name, train, valid, 3, 5), named, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", BASELINES)
def test_fewer_different_steps_than_kinds(name):
    """Constant controls, two different steps, demonstrations of one step."""
    demos = [Demonstration(f"demo_{n}", {"x": np.full((1 + n, 1), n % 2)}, np.ones((1 + n, 2))) for n in range(3)]
    found = segment(name, Demonstrations(tuple(demos)), Demonstrations(tuple(demos)), 5, 0)
    assert [len(one) for one in found] == [1, 2, 3]


def test_a_package_that_is_missing_is_a_line(monkeypatch):
    for name, package in (("hmm", "hmmlearn"), ("change_points", "ruptures")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(BadInput, match=r"needs \w+; install it with: pip install 'ddco-pyro\[segments\]'"):
            segment(name, planted(2), planted(2), 2, 0)
