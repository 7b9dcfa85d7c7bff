"""Controls that are exactly one value in many steps: what is decided, fitted, emitted, exported and compared."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from command_line import call
from odd_files.atoms import ROWS, at_bounds, no_ops
from planted import make_spec

import ddco_pyro
from ddco_pyro.data.controls import control_dimensions, control_parts, described
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.exporting import TOLERANCE, export, runner
from ddco_pyro.model.emissions import Hurdle
from ddco_pyro.spec import ControlSpec, load_spec, with_overrides


def spec_of(options=3, epochs=6, path="unused.hdf5", **control):
    control = {"std": {"learn": True, "per_option": True}, **control}
    spec = make_spec((options,), control=control, epochs=epochs, initialize="vq_controls")
    return with_overrides(spec, {"demonstrations": {"path": str(path), "valid_fraction": 0.34}})


# --- without skill ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at_once", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_without_skill_options_gain_nothing(at_once):
    """Half of the steps are exactly 0 at random: three options and a flat policy, held out, nats per step.

    With Gaussian controls the options seem better by more than a nat; with a probability at 0 the difference is
    within three of its standard errors, which are below 0.025.
    """
    demos, gained = no_ops(30, at_once=at_once), {}
    for kind in ("gaussian", "auto"):
        spec = with_overrides(spec_of(epochs=100, kind=kind), {"compare_with": ["flat"]})
        gained[kind] = ddco_pyro.fit(spec, demos).metrics.comparison["flat"].difference
    assert gained["gaussian"].nats_per_step > 1
    assert abs(gained["auto"].nats_per_step) < 3 * gained["auto"].standard_error < 0.075


# --- what is decided --------------------------------------------------------------------------------------------------


def decided(demos, **control):
    return control_parts(ControlSpec(**control), control_dimensions({demo.name: demo.actions for demo in demos}))


def test_dimensions_that_rest_at_once_share_a_probability():
    (together,) = decided(no_ops())
    assert (together.kind, together.dims, together.exact, Hurdle.size(together)) == (
        "hurdle",
        (0, 1, 2),
        (0.0, 0.0, 0.0),
        4,
    )
    assert described([together]) == ["control dimensions 0-2: hurdle (exactly 0 in 49.6 % of the steps)"]
    apart = decided(no_ops(at_once=False))
    assert [(part.kind, part.dims, Hurdle.size(part)) for part in apart] == [("hurdle", (d,), 2) for d in range(3)]


def test_beside_its_value_a_hurdle_is_clipped_where_it_has_bounds():
    for part in decided(at_bounds()):
        assert (part.kind, part.low, part.high) == ("hurdle", (-1.0,), (1.0,))
        assert part.why.endswith("; often at an extreme")


def test_a_value_is_that_of_the_demonstrations_however_it_is_rounded():
    """0.1 in a file of float32 is another number than 0.1 in a spec."""
    stored = float(np.float32(0.1))
    controls = np.where(np.arange(60) % 2 == 0, stored, np.random.default_rng(0).normal(size=60))[:, None]
    for value in (0.1, stored, None):
        parts = [{"name": "stick", "dims": [0], "kind": "hurdle", "value": value}]
        (part,) = control_parts(ControlSpec(parts=parts), control_dimensions({"demo": controls}))
        assert part.exact == (stored,)


def test_a_declared_value_may_be_an_extreme():
    controls = np.abs(no_ops()[0].actions[:, :1])
    parts = [{"name": "pedal", "dims": [0], "kind": "hurdle", "value": 0.0}]
    (part,) = control_parts(ControlSpec(parts=parts), control_dimensions({"demo": controls}))
    assert (part.exact, part.low, part.high) == ((0.0,), (-np.inf,), (np.inf,))
    assert [part.kind for part in control_parts(ControlSpec(), control_dimensions({"demo": controls}))] == ["clipped"]


# --- from file to controller ------------------------------------------------------------------------------------------

STILL = float(np.float32(0.3))


def mixed():
    """Two dimensions that rest at 0.3 and 0 at once, one that rests at 0 and reaches ±1, and a switch."""
    random, made = np.random.default_rng(0), []
    for index in range(8):
        state = random.normal(size=(40, 4))
        rests, halts = state[:, :1] > 0.5, state[:, 1:2] < -0.4
        free = state + random.normal(0, 0.2, state.shape)
        pair = np.where(rests, [STILL, 0.0], free[:, :2] + [2.0, -0.5])
        third = np.where(halts, 0.0, free[:, 2:3].clip(-1, 1))
        controls = np.concatenate([third, pair, free[:, 3:] > 0], axis=1)
        made.append(Demonstration(f"demo_{index}", {"state": state}, controls))
    return Demonstrations(tuple(made))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hurdle")
    mixed().write(folder / "demos.hdf5")
    return ddco_pyro.fit(spec_of(2, epochs=40, path=folder / "demos.hdf5"), out=folder / "run")


def test_what_was_decided_comes_back_from_the_run(fitted):
    assert [(part.kind, part.dims) for part in fitted.hierarchy.scaling.parts] == [
        ("hurdle", (0,)), ("hurdle", (1, 2)), ("binary", (3,)),
    ]  # fmt: skip
    again = ddco_pyro.load(fitted.folder)
    assert again.hierarchy.scaling.parts == fitted.hierarchy.scaling.parts
    np.testing.assert_array_equal(again.log_likelihood(mixed()), fitted.log_likelihood(mixed()))
    assert again.metrics.measure == {
        "0": ["hurdle", -1.0, 1.0, 0.0, [0]],
        "1": ["hurdle", None, None, STILL, [1, 2]],
        "2": ["hurdle", None, None, 0.0, [1, 2]],
        "3": ["binary", 0.0, 1.0],
    }
    assert again.metrics.engine_check.value < 1e-6


def test_scaling_keeps_exactly_the_value_apart(fitted):
    """Numbers that differ by rounding are the value, others are not, and what is scaled comes back exactly."""
    scaling = fitted.hierarchy.scaling
    rows = np.tile([0.0, STILL, 0.0, 1.0], (5, 1))
    rows[1:, 1] = np.nextafter(STILL, -1), np.nextafter(STILL, 1), STILL * (1 - 1e-6), STILL * (1 + 1e-6)
    scaled = np.float32(scaling.scaled(rows))
    assert ((scaled[:, 1] == 0) == [True, True, True, False, False]).all()
    assert (scaled[:, [0, 2]] == 0).all()
    np.testing.assert_array_equal(scaling.unscaled(torch.from_numpy(scaled))[0], rows[0])


@pytest.mark.parametrize("control", ["mean", "sample"])
@pytest.mark.usefixtures("numpy_alone")
def test_values_are_emitted_exactly_and_exports_act_alike(fitted, control, tmp_path):
    acting = ddco_pyro.load(fitted.folder)
    changed = acting.__class__(with_overrides(acting.spec, {"rollout.control": control}), acting.hierarchy)
    assert export(changed, tmp_path / "out")["numpy"][0] < TOLERANCE
    exported, original = runner.Runner(tmp_path / "out"), changed.controller()
    ours, theirs = [], []
    for observation in np.random.default_rng(3).normal(0, 1.5, (150, 4)):
        ours.append(exported.act({"state": observation}))
        theirs.append(original.act({"state": observation}))
    ours, theirs = np.stack(ours), np.stack(theirs)
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    for own in (ours, theirs):
        rests = own[:, 1] == STILL
        assert 0.1 < rests.mean() < 0.9
        np.testing.assert_array_equal(rests, own[:, 2] == 0)
        assert {-1.0, 0.0, 1.0} <= set(own[:, 0])
        assert (np.abs(own[:, 0]) <= 1).all()


@pytest.mark.parametrize("row", ROWS)
def test_files_with_such_values_are_begun_and_fitted(row, tmp_path):
    path = ROWS[row].make(tmp_path)
    assert call("init", path, "--out", tmp_path / "spec.yaml").status == 0
    ddco_pyro.fit(load_spec(tmp_path / "spec.yaml", ["training.epochs=2", "compare_with=[]"]))
