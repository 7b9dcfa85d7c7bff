"""Few demonstrations: every one trains the model, and held-out results are of fits that leave one out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations, DemonstrationsError
from ddco_pyro.drawing import words
from ddco_pyro.spec import parse_spec, with_overrides

LINEAR = {"network": "linear"}


def spec_of(**demonstrations):
    return parse_spec(
        {
            "demonstrations": {"path": "unused.hdf5", "leave_one_out": True, "labels": "skill", **demonstrations},
            "observations": ["state"],
            "control": {"std": {"learn": True, "floor": 0.01, "per_option": True}},
            "hierarchy": {
                "levels": [{"count": 2, "policy": LINEAR, "termination": LINEAR}],
                "meta_policy": LINEAR,
            },
            "compare_with": [{"kind": "flat", "policy": LINEAR}],
            "training": {
                "optimizer": {"name": "em"},
                "epochs": 30,
                "tune_fraction": 0,
                "initialize": "vq_controls",
            },
        }
    )


def planted(number=4):
    """Two skills one after the other, of opposite controls in different halves of the plane."""
    random, each = np.random.default_rng(3), []
    for n in range(number):
        skill = np.repeat([0, 1], [8 + n, 12 - n])
        state = random.normal(size=(20, 2)) + 2.0 * np.where(skill == 0, -1, 1)[:, None]
        actions = np.where(skill[:, None] == 0, state, -state) + 0.1 * random.normal(size=state.shape)
        each.append(Demonstration(f"demo_{n}", {"state": state}, actions, labels={"skill": skill}))
    return Demonstrations(tuple(each))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return ddco_pyro.fit(spec_of(), planted(), out=tmp_path_factory.mktemp("few") / "run")


def test_every_demonstration_trains_and_is_held_out_from_a_fit_without_it(run):
    demos, counts = planted(), run.metrics.demonstrations
    assert (counts.train, counts.tune, counts.valid, counts.left_out) == (4, 0, 4, True)
    whole = with_overrides(run.spec, {"demonstrations.leave_one_out": False})
    for method, model in (("ddco", run), *run.baselines.items()):
        spec = with_overrides(model.spec, {"demonstrations.leave_one_out": False})
        each = {row.name: row.log_likelihood for row in model.metrics.valid}
        for name in demos.names[:1]:
            masked = replace(demos, masks={"valid": (name,)})  # the same held out by a mask instead
            apart = ddco_pyro.fit(with_overrides(spec, {"compare_with": []}), masked)
            assert each[name] == pytest.approx(float(apart.log_likelihood(demos.select([name]))[0])), method
            assert each[name] < float(model.log_likelihood(demos.select([name]))[0])  # which the model was fitted to
    everything = ddco_pyro.fit(with_overrides(whole, {"demonstrations.valid_fraction": 0.0, "compare_with": []}), demos)
    np.testing.assert_array_equal(run.log_likelihood(demos), everything.log_likelihood(demos))


def test_options_of_the_fits_without_one_are_named_as_the_fits_own(run):
    """Else the NMI over all demonstrations would be of a mixture of names."""
    assert run.metrics.agreement.train[0].nmi > 0.95
    assert run.metrics.agreement.valid[0].nmi > 0.95


def test_a_run_has_the_models_without_one_and_goes_on_with_them(run, tmp_path):
    again = ddco_pyro.load(run.folder)
    for name, model in run.without.items():
        for key, value in again.without[name].state_dict().items():
            assert (value == model.state_dict()[key]).all(), key
    (run.folder / "metrics.json").rename(tmp_path / "metrics.json")  # as if it had been interrupted
    before = {path: path.stat().st_mtime_ns for path in run.folder.rglob("left_out/*/model.safetensors")}
    assert len(before) == 8
    unchanged = ddco_pyro.fit(run.spec, out=run.folder).metrics
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert unchanged.model_copy(update={"seconds": {}}) == run.metrics.model_copy(update={"seconds": {}})


def test_what_masks_hold_out_cannot_be_trained_with():
    masked = replace(planted(), masks={"valid": ("demo_0",)})
    with pytest.raises(DemonstrationsError, match="leave_one_out: trains with every demonstration"):
        ddco_pyro.fit(spec_of(), masked)


def test_runs_are_compared_by_what_the_fits_without_one_say(run):
    compared = ddco_pyro.compare([run.folder, run.folder / "baselines" / "flat"])
    each = {row.name: row.each for row in compared.rows}
    assert each[str(run.folder)] == pytest.approx([row.log_likelihood for row in run.metrics.valid])

    assert "each is held out from a fit without it" in words.verdict(run.metrics)
    assert (
        words.division(run.metrics.demonstrations)
        == "4 for training, 0 for tuning, each held out from a fit without it"
    )
