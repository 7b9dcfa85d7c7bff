"""Control dimensions that never change: no part of the model, emitted exactly, and said everywhere.

The truth is a second file without those columns: fitted to it, the same numbers have to come out.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from planted import make_spec
from random_demonstrations import numbered

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.selection.grid import divide
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.networks import Dimensions

STILL = {1: 0.1, 3: -7.0}
"""Dimension to value; 0.1 is no float32."""

FREE = [0, 2]


def controls(random: np.random.Generator, steps: int) -> np.ndarray:
    """[T, 4]: a free dimension, a constant one, a switch, another constant one."""
    found = random.normal(3.0, 2.0, (steps, 4))
    found[:, 2] = np.where(random.random(steps) < 0.4, 1.0, -1.0)
    for dimension, value in STILL.items():
        found[:, dimension] = value
    return found


def make_demonstrations(number: int = 8) -> Demonstrations:
    random = np.random.default_rng(0)
    demos = numbered(({"state": random.normal(size=(9, 3))}, controls(random, 9)) for _ in range(number))
    return replace(demos, masks={"valid": (f"demo_{number - 1}", f"demo_{number - 2}")})


def moved(name: str) -> Demonstrations:
    """The same where dimension 3 changes in a demonstration."""
    demos = make_demonstrations()
    demos.select([name])[0].actions[4, 3] = 0.0
    return demos


def fitted(demos: Demonstrations, folder: Path) -> Fit:
    spec = make_spec((2,), control={"std": {"learn": True}}, starts=["vq_controls"], epochs=3, batch_size=2)
    own = {"hierarchy.meta_policy.emits": ["options", "control"], "compare_with": ["flat"]}
    return ddco_pyro.fit(with_overrides(spec, own), demos, out=folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    """Fitted to all four dimensions."""
    return fitted(make_demonstrations(), tmp_path_factory.mktemp("constant") / "whole")


@pytest.fixture(scope="module")
def reduced(tmp_path_factory: pytest.TempPathFactory) -> Fit:
    """Fitted to those that vary."""
    demos = make_demonstrations()
    varying = tuple(replace(demo, actions=demo.actions[:, FREE]) for demo in demos)
    return fitted(replace(demos, demonstrations=varying), tmp_path_factory.mktemp("constant") / "reduced")


def test_they_are_no_part_of_the_likelihood(whole: Fit, reduced: Fit) -> None:
    for ours, theirs in ((whole, reduced), (whole.baselines["flat"], reduced.baselines["flat"])):
        for part in ("log_likelihood_per_step", "valid", "parameters"):
            assert getattr(ours.metrics, part) == getattr(theirs.metrics, part)
        for part in ("train", "valid"):
            found = getattr(ours.metrics.log_likelihood_by_dimension, part)
            assert [found.by_dimension[d] for d in STILL] == [None, None]
            own = [found.by_dimension[d] for d in FREE]
            assert own == getattr(theirs.metrics.log_likelihood_by_dimension, part).by_dimension
            total = sum(own) + found.options
            assert total == pytest.approx(getattr(ours.metrics.log_likelihood_per_step, part), rel=1e-6)
    assert whole.metrics.divergences == reduced.metrics.divergences
    assert whole.metrics.comparison["flat"].difference == reduced.metrics.comparison["flat"].difference


@pytest.mark.parametrize("control", ["mean", "sample"])
def test_a_run_that_is_read_again_emits_and_takes_them(whole: Fit, reduced: Fit, control: str) -> None:
    """The constants exactly, the rest as the model of the rest has it."""
    random, again = np.random.default_rng(5), ddco_pyro.load(whole.folder)
    acting, expected = (Controller(one.hierarchy, control, seed=3) for one in (again, reduced))
    monitors, given = (again.monitor(), reduced.monitor()), None
    for _ in range(6):
        observation = {"state": random.normal(size=3)}
        for monitor, columns in zip(monitors, (slice(None), FREE), strict=True):
            monitor.step(observation, None if given is None else given[columns])
        torch.testing.assert_close(*(monitor.belief for monitor in monitors), rtol=0, atol=0)
        given = acting.act(observation)
        assert given.shape == (4,)
        assert {d: given[d] for d in STILL} == STILL
        np.testing.assert_array_equal(given[FREE], expected.act(observation))
    assert monitors[0].log_likelihood == monitors[1].log_likelihood != 0


def test_what_changes_in_held_out_demonstrations_alone_stays_in(tmp_path: Path) -> None:
    found = fitted(moved("demo_7"), tmp_path / "run")
    assert found.hierarchy.scaling.varying.tolist() == [0, 2, 3]
    assert np.isfinite(found.metrics.log_likelihood_by_dimension.valid.by_dimension[3])


def test_folds_decide_it_once_for_all() -> None:
    """By all demonstrations, be they in one fold alone or set apart by the file."""
    assert [Dimensions.of(fold).constant for fold in divide(make_demonstrations(), 3, 0)] == [STILL] * 3
    for name in ("demo_0", "demo_7"):
        assert [Dimensions.of(fold).constant for fold in divide(moved(name), 3, 0)] == [{1: 0.1}] * 3
