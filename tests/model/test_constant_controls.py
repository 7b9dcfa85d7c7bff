"""Control dimensions that never change: no part of the model, emitted exactly, and said everywhere.

The truth is a second file without those columns: fitted to it, the same numbers have to come out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import call
from planted import make_spec

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.fitting.fit import fit
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.selection.folds import divide
from ddco_pyro.spec import Spec, with_overrides
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
    records = [
        Demonstration(f"demo_{n}", {"state": random.normal(size=(9, 3))}, controls(random, 9)) for n in range(number)
    ]
    return Demonstrations(tuple(records), {"valid": (f"demo_{number - 1}", f"demo_{number - 2}")})


def with_controls(demos: Demonstrations, change: dict[str, np.ndarray] | None = None, columns=slice(None)):
    """The same demonstrations with other controls, or with some columns of them."""
    records = [Demonstration(d.name, d.observations, (change or {}).get(d.name, d.actions)[:, columns]) for d in demos]
    return Demonstrations(tuple(records), demos.masks)


def spec_for(path: Path, **changes: object) -> Spec:
    spec = make_spec((2,), control={"std": {"learn": True}}, starts=["vq_controls"], epochs=3, batch_size=2)
    own = {"hierarchy.meta_policy.emits": ["options", "control"], "compare_with": ["flat"]}
    return with_overrides(spec, {**own, "demonstrations": {"path": str(path)}, **changes})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("constant")


@pytest.fixture(scope="module")
def whole(folder: Path) -> Fit:
    """Fitted to all four dimensions."""
    make_demonstrations().write(folder / "whole.hdf5")
    return fit(spec_for(folder / "whole.hdf5"), out=folder / "whole")


@pytest.fixture(scope="module")
def reduced(folder: Path) -> Fit:
    """Fitted to those that vary."""
    with_controls(make_demonstrations(), columns=FREE).write(folder / "reduced.hdf5")
    return fit(spec_for(folder / "reduced.hdf5"), out=folder / "reduced")


# --- the likelihood ---------------------------------------------------------------------------------------------------


def test_they_are_no_part_of_the_likelihood(whole: Fit, reduced: Fit) -> None:
    for ours, theirs in ((whole, reduced), (whole.baselines["flat"], reduced.baselines["flat"])):
        for part in ("log_likelihood_per_step", "valid", "parameters"):
            assert getattr(ours.metrics, part) == getattr(theirs.metrics, part)
    assert whole.metrics.divergences == reduced.metrics.divergences
    assert whole.metrics.comparison["flat"].difference == reduced.metrics.comparison["flat"].difference
    assert whole.hierarchy.scaling.varying.tolist() == FREE


def test_each_dimension_has_its_part_of_it(whole: Fit, reduced: Fit) -> None:
    for ours, theirs in ((whole, reduced), (whole.baselines["flat"], reduced.baselines["flat"])):
        for part in ("train", "valid"):
            found = getattr(ours.metrics.log_likelihood_by_dimension, part)
            assert [found.by_dimension[d] for d in STILL] == [None, None]
            own = [found.by_dimension[d] for d in FREE]
            assert own == getattr(theirs.metrics.log_likelihood_by_dimension, part).by_dimension
            total = sum(own) + found.options
            assert total == pytest.approx(getattr(ours.metrics.log_likelihood_per_step, part), rel=1e-6)
    assert whole.metrics.log_likelihood_by_dimension.train.options < 0
    assert whole.baselines["flat"].metrics.log_likelihood_by_dimension.train.options == 0


def test_what_they_are_comes_back_from_the_run(whole: Fit) -> None:
    again = ddco_pyro.load(whole.folder)
    demos = make_demonstrations()
    np.testing.assert_array_equal(again.log_likelihood(demos), whole.log_likelihood(demos))
    assert dict(zip((1, 3), again.hierarchy.scaling.constant.tolist(), strict=True)) == STILL


# --- what acts --------------------------------------------------------------------------------------------------------


def observations(number: int = 6) -> list[dict[str, np.ndarray]]:
    random = np.random.default_rng(5)
    return [{"state": random.normal(size=3)} for _ in range(number)]


def check_control(found: np.ndarray, expected: np.ndarray) -> None:
    """The constants exactly, the rest as the model of the rest has it."""
    assert found.shape == (4,)
    assert {d: found[d] for d in STILL} == STILL
    np.testing.assert_array_equal(found[FREE], expected)


@pytest.mark.parametrize("control", ["mean", "sample"])
def test_the_controller_emits_them(whole: Fit, reduced: Fit, control: str) -> None:
    acting, expected = (Controller(one.hierarchy, control, seed=3) for one in (whole, reduced))
    for observation in observations():
        check_control(acting.act(observation), expected.act(observation))


def test_the_monitor_takes_whole_controls(whole: Fit, reduced: Fit) -> None:
    monitors, control = (whole.monitor(), reduced.monitor()), None
    for observation in observations():
        for monitor, columns in zip(monitors, (slice(None), FREE), strict=True):
            monitor.step(observation, None if control is None else control[columns])
        torch.testing.assert_close(*(monitor.belief.levels for monitor in monitors), rtol=0, atol=0)
        control = controls(np.random.default_rng(1), 1)[0]
    assert monitors[0].log_likelihood == monitors[1].log_likelihood != 0


# --- which are constant -----------------------------------------------------------------------------------------------


def test_what_changes_in_held_out_demonstrations_alone_stays_in(folder: Path, tmp_path: Path) -> None:
    demos = make_demonstrations()
    changed = demos.select(["demo_7"])[0].actions.copy()
    changed[4, 3] = 0.0
    path = tmp_path / "demos.hdf5"
    with_controls(demos, {"demo_7": changed}).write(path)
    found = fit(spec_for(path, compare_with=[]), out=tmp_path / "run")
    assert found.hierarchy.scaling.varying.tolist() == [0, 2, 3]
    held_out = found.metrics.log_likelihood_by_dimension.valid.by_dimension
    assert np.isfinite(held_out[3])
    assert call("segment", tmp_path / "run", path, "--csv", tmp_path / "a.csv").status == 0


def test_folds_decide_it_once_for_all(tmp_path: Path) -> None:
    """By all demonstrations, be they in one fold alone or set apart by the file."""
    demos = make_demonstrations()
    assert [Dimensions.of(fold).constant for fold in divide(demos, 3, 0)] == [STILL] * 3
    for name in ("demo_0", "demo_7"):
        changed = demos.select([name])[0].actions.copy()
        changed[4, 3] = 0.0
        folds = divide(with_controls(demos, {name: changed}), 3, 0)
        assert [Dimensions.of(fold).constant for fold in folds] == [{1: 0.1}] * 3
