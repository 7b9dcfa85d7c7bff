"""What kind each control dimension is found to be, what is refused, and that only the possible is emitted."""

import numpy as np
import pytest
import torch
from command_line import refused
from planted import make_spec

import ddco_pyro
from ddco_pyro.acting.controller import Controller
from ddco_pyro.data.controls import control_dimensions, control_parts
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.exporting import TOLERANCE, export, runner
from ddco_pyro.spec import ControlSpec, SpecError, dump_spec, with_overrides


def mixed(seed=0, steps=30):
    """[T, 5]: free, at bounds ±2 and within, a switch between 0.1 and 0.7, at its upper bound, constant.

    The constant is no float32.
    """
    random = np.random.default_rng(seed)
    wide = random.normal(0, 3, (steps, 2))
    return np.stack(
        [
            random.normal(5, 2, steps),
            wide[:, 0].clip(-2, 2),
            np.where(random.random(steps) < 0.4, 0.7, 0.1),
            np.minimum(wide[:, 1], 1.0),
            np.full(steps, 0.1),
        ],
        axis=1,
    )


def demonstrations(actions=mixed, number=6):
    """Demonstrations whose state says something of the control."""
    made = []
    for n in range(number):
        controls = np.asarray(actions(n), dtype=float)
        noise = np.random.default_rng(100 + n).normal(0, 0.3, controls.shape)
        made.append(Demonstration(f"demo_{n}", {"state": controls + noise}, controls))
    return Demonstrations(tuple(made))


def spec_of(**control):
    spec = make_spec((2,), control={"std": {"learn": True}, **control}, epochs=6)
    emits = {"hierarchy.meta_policy.emits": ["options", "control"]}
    return with_overrides(spec, {"demonstrations.valid_fraction": 0.34, **emits})


def kinds(actions, **control):
    parts = control_parts(ControlSpec(**control), control_dimensions({"demo": actions}))
    return {dimension: part.kind for part in parts for dimension in part.dims}


def test_whole_numbers_alone_are_discrete_actions():
    actions = np.random.default_rng(0).integers(0, 5, (40, 1)).astype(float)
    (part,) = control_parts(ControlSpec(), control_dimensions({"demo": actions}))
    assert (part.kind, part.values) == ("categorical", (0.0, 1.0, 2.0, 3.0, 4.0))
    both = np.concatenate([actions, np.random.default_rng(1).normal(size=(40, 1))], axis=1)
    assert "categorical" not in kinds(both).values()


def whole(seed, columns=2):
    """[T, 2] of an integer type: -1, 0 or 1, and 0, 1 or 2."""
    return np.random.default_rng(seed).integers(-1, 2, (20, columns)) + np.arange(columns)


def test_of_an_integer_type_every_column_is_discrete_whatever_its_sign():
    parts = control_parts(ControlSpec(), control_dimensions({"demo": whole(0)}))
    assert [(part.dims, part.kind, part.values) for part in parts] == [
        ((0,), "categorical", (-1.0, 0.0, 1.0)),
        ((1,), "categorical", (0.0, 1.0, 2.0)),
    ]
    assert parts == control_parts(ControlSpec(), control_dimensions({"one": whole(1), "two": whole(0)}))
    assert kinds(whole(0).astype(float)) == {0: "hurdle", 1: "hurdle"}
    assert kinds(whole(0).astype(float), kind="categorical") == {0: "categorical", 1: "categorical"}
    many = np.arange(100).reshape(-1, 1)
    assert kinds(many) == {0: "gaussian"}
    assert kinds(np.where(many < 50, -1, 1)) == {0: "binary"}


def test_two_discrete_columns_are_a_distribution_and_act_in_exports_as_in_the_run(tmp_path):
    """The probabilities of all nine actions sum to 1; nothing else is emitted."""
    made = []
    for n in range(6):
        noise = np.random.default_rng(n).normal(0, 0.1, (20, 2))
        made.append(Demonstration(f"demo_{n}", {"state": whole(n) + noise}, whole(n)))
    fit = ddco_pyro.fit(spec_of(), Demonstrations(tuple(made)))
    actions = np.stack(np.meshgrid([-1, 0, 1], [0, 1, 2]), axis=-1).reshape(-1, 2)
    state = {"state": np.zeros((1, 2))}
    each = [Demonstration(f"demo_{n}", state, action[None]) for n, action in enumerate(actions)]
    np.testing.assert_allclose(np.exp(fit.log_likelihood(Demonstrations(tuple(each)))).sum(), 1.0, rtol=1e-6)
    controller = Controller(fit.hierarchy, "sample")
    controller.reset(0)
    emitted = {tuple(controller.act({"state": np.zeros(2)})) for _ in range(60)}
    assert len(emitted) > 3
    assert emitted <= set(map(tuple, actions.astype(float)))
    assert export(fit, tmp_path / "out")["numpy"][0] < TOLERANCE


def test_parts_by_name_come_first_and_the_rest_follows():
    parts = [{"name": "arm", "dims": [1, 0], "kind": "gaussian"}, {"name": "jaw", "dims": [2, 4]}]
    assert kinds(mixed(), parts=parts) == {0: "gaussian", 1: "gaussian", 2: "binary", 3: "clipped"}


HALVES = {"parts": [{"name": "a", "dims": [0, 2], "kind": "categorical"}]}


@pytest.mark.parametrize(
    ("control", "message"),
    [
        ({"kind": "binary"}, "control.kind: control dimension 0 takes more than two values; it is no switch"),
        ({"kind": "hurdle"}, "control dimension 0 is at no value inside its range in 5 % of the steps"),
        ({"parts": [{"name": "a", "dims": [9]}]}, "control.parts.0.dims: there is no control dimension 9"),
        (HALVES, "control dimension 0 is not of whole"),
    ],
)
def test_what_does_not_fit_the_demonstrations_is_refused(control, message):
    with pytest.raises(SpecError, match=message):
        control_parts(spec_of(**control).control, control_dimensions({"demo": mixed()}))


@pytest.mark.parametrize(
    "parts",
    [
        [{"name": "a", "dims": [0]}, {"name": "b", "dims": [1, 0]}],
        [{"name": "a", "dims": [2], "kind": "binary", "std": 1.0}],
    ],
)
def test_contradictions_in_parts_are_refused(parts):
    with pytest.raises(SpecError, match=r"control\.parts\.\d\."):
        spec_of(parts=parts)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    return ddco_pyro.fit(spec_of(), demonstrations(), out=tmp_path_factory.mktemp("runs") / "mixed")


STILL = float(np.float32(0.3))


def resting():
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


def resting_spec(options=3, epochs=6, **control):
    control = {"std": {"learn": True, "per_option": True}, **control}
    spec = make_spec((options,), control=control, epochs=epochs, starts=["vq_controls"])
    return with_overrides(spec, {"demonstrations.valid_fraction": 0.34})


@pytest.fixture(scope="module")
def rested(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "rested"
    return ddco_pyro.fit(resting_spec(2, epochs=40), resting(), out=folder)


def test_switches_and_bounds_are_emitted_exactly(fitted):
    """In states far beyond the demonstrations, where means lie beyond every bound."""
    controller = Controller(fitted.hierarchy, "sample")
    controls = []
    for seed in range(8):
        controller.reset(seed)
        rows = np.random.default_rng(seed).normal(0, 50, (20, 5))
        controls += [controller.act({"state": row}) for row in rows]
    emitted = np.stack(controls)
    assert set(emitted[:, 2]) == {0.1, 0.7}
    assert set(emitted[:, 4]) == {0.1}
    assert (np.abs(emitted[:, 1]) <= 2).all()
    assert (emitted[:, 3] <= 1).all()
    assert {-2.0, 2.0} <= set(emitted[:, 1])
    assert 1.0 in emitted[:, 3]


@pytest.fixture(params=["fitted", "rested"])
def run(request):
    """Of each kind of controls in turn."""
    return request.getfixturevalue(request.param)


MEASURES = {
    "mixed": {"0": ["gaussian"], "1": ["clipped", -2.0, 2.0], "2": ["binary", 0.1, 0.7],
              "3": ["clipped", None, 1.0]},
    "rested": {
        "0": ["hurdle", -1.0, 1.0, 0.0, [0]], "1": ["hurdle", None, None, STILL, [1, 2]],
        "2": ["hurdle", None, None, 0.0, [1, 2]], "3": ["binary", 0.0, 1.0],
    },
}  # fmt: skip


def test_what_was_decided_comes_back_from_the_run(run):
    again = ddco_pyro.load(run.folder)
    assert again.hierarchy.scaling.parts == run.hierarchy.scaling.parts
    before, after = (one.log_likelihood(run.demonstrations) for one in (run, again))
    np.testing.assert_array_equal(after, before)
    assert again.metrics.measure == MEASURES[run.folder.name]
    assert again.metrics.engine_check.value < 1e-6


@pytest.mark.parametrize("control", ["mean", "sample"])
def test_exports_act_as_the_run_does(run, tmp_path, control):
    """Bounds and values that are taken often are emitted by both at the same steps, to the bit."""
    changed = run.__class__(with_overrides(run.spec, {"rollout.control": control}), run.hierarchy)
    assert export(changed, tmp_path / "out")["numpy"][0] < TOLERANCE
    exported, original = runner.Runner(tmp_path / "out"), changed.controller()
    size, exact = run.hierarchy.encoder.shapes["state"], [-2.0, -1.0, 0.0, 0.1, STILL, 0.7, 1.0, 2.0]
    seen = np.random.default_rng(3).normal(0, 1.5, (150, *size))
    ours, theirs = (np.stack([acts.act({"state": row}) for row in seen]) for acts in (exported, original))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    kept = (np.where(np.isin(each, exact), each, 9) for each in (ours, theirs))
    np.testing.assert_array_equal(*kept)
    if run.folder.name == "rested":
        rests = ours[:, 1] == STILL
        assert 0.1 < rests.mean() < 0.9
        np.testing.assert_array_equal(rests, ours[:, 2] == 0)
        assert {-1.0, 0.0, 1.0} <= set(ours[:, 0])
        assert (np.abs(ours[:, 0]) <= 1).all()


def in_file(spec, path, **changes):
    """The spec with the demonstrations of a file."""
    return with_overrides(spec, {"demonstrations.path": str(path), **changes})


def test_a_value_that_a_switch_does_not_have_is_one_line(fitted):
    broken = demonstrations(lambda n: np.where(np.arange(5) == 2, 0.5, mixed(n)), number=1)
    says = r"2 is 0\.5 at step 0, .*; repair it, or leave demo_0 out$"
    with pytest.raises(DemonstrationsError, match=says):
        fitted.log_likelihood(broken)


def test_different_measures_are_not_ranked(fitted, tmp_path):
    path = tmp_path / "demos.hdf5"
    demonstrations().write(path)
    runs = []
    for kind in ("auto", "gaussian"):
        runs.append(ddco_pyro.fit(in_file(spec_of(kind=kind), path), out=tmp_path / kind).folder)
    says = "control dimension 1 is clipped with bounds -2 and 2 in one and gaussian in the other"
    refused(says, "compare", *runs)
    grid = in_file(spec_of(), path, selection={"folds": 2, "grid": {"control.kind": ["auto", "gaussian"]}})
    (tmp_path / "grid.yaml").write_text(dump_spec(grid))
    said = "kind = auto and kind = gaussian measure different things: control dimension 1"
    refused(said, "select", tmp_path / "grid.yaml", "--out", tmp_path / "selected")


def no_ops(number=8, steps=30, dimensions=3, at_once=True):
    """A teleoperator who rests, without skill: in half of the steps the control is exactly 0, or else normal.

    :param at_once: in all dimensions at once; else in each by itself.
    """
    random, made = np.random.default_rng(0), []
    for index in range(number):
        still = random.random((steps, 1 if at_once else dimensions)) < 0.5
        controls = np.where(still, 0.0, random.normal(size=(steps, dimensions)))
        made.append(Demonstration(f"demo_{index}", {"state": random.normal(size=(steps, 2))}, controls))
    return Demonstrations(tuple(made))


@pytest.mark.parametrize("at_once", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_without_skill_options_gain_nothing(at_once):
    """Half of the steps are exactly 0 at random: three options and a flat policy, held out, nats per step.

    With Gaussian controls the options seem better by more than a nat; with a probability at 0 the difference
    is within three of its standard errors, which are below 0.025.
    """
    demos, gained = no_ops(30, at_once=at_once), {}
    for kind in ("gaussian", "auto"):
        spec = with_overrides(resting_spec(epochs=100, kind=kind), {"compare_with": ["flat"]})
        gained[kind] = ddco_pyro.fit(spec, demos).metrics.comparison["flat"].difference
    assert gained["gaussian"].nats_per_step > 1
    assert abs(gained["auto"].nats_per_step) < 3 * gained["auto"].standard_error < 0.075


def test_scaling_keeps_exactly_the_value_apart(rested):
    """Numbers that differ by rounding are the value, others are not, and what is scaled comes back exact."""
    scaling = rested.hierarchy.scaling
    rows = np.tile([0.0, STILL, 0.0, 1.0], (5, 1))
    rows[1:, 1] = np.nextafter(STILL, -1), np.nextafter(STILL, 1), STILL * (1 - 1e-6), STILL * (1 + 1e-6)
    scaled = np.float32(scaling.scaled(rows))
    assert ((scaled[:, 1] == 0) == [True, True, True, False, False]).all()
    assert (scaled[:, [0, 2]] == 0).all()
    np.testing.assert_array_equal(scaling.emitted(torch.from_numpy(scaled))[0], rows[0])
