"""A fit repeated with other training seeds."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from command_line import call, done, refused, with_set
from planted import LINEAR, small_spec
from random_demonstrations import numbered
from scipy import stats

import ddco_pyro
from ddco_pyro.drawing import words
from ddco_pyro.evaluation import verdicts
from ddco_pyro.report import training
from ddco_pyro.spec import load_spec, with_overrides

SPEC = {
    "task": "toy",
    "demonstrations": {"count": 8},
    "observations": ["offsets", "visited"],
    "hierarchy": {"levels": [{"count": 2, "policy": LINEAR}], "meta_policy": LINEAR},
    "compare_with": [{"kind": "flat", "policy": LINEAR}, "mixture"],
    "training": {"epochs": 4, "starts": ["random"], "layerwise": False},
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A spec and a run of it with three training seeds, by the command, and how that ended."""
    folder = tmp_path_factory.mktemp("seeds")
    spec = folder / "spec.yaml"
    spec.write_text(yaml.safe_dump(SPEC))
    return spec, folder / "run", call("fit", spec, "--out", folder / "run", "--seeds", 3, "--jobs", 1)


def test_each_repetition_is_that_fit_with_another_training_seed(written):
    spec, run, ended = written
    assert ended.status == 0, ended.err
    assert sorted(path.name for path in (run / "seeds").iterdir()) == ["1", "2"]
    alone = ddco_pyro.fit(with_overrides(load_spec(spec), {"training.seed": 2}))
    again = ddco_pyro.load(run / "seeds" / "2")
    for name in ("flat", "mixture"):
        assert again.baselines[name].metrics.log_likelihood_per_step == (
            alone.baselines[name].metrics.log_likelihood_per_step
        )
    runs = [ddco_pyro.load(path) for path in (run, run / "seeds" / "1")]
    held_out = [[row.name for row in one.metrics.valid] for one in runs]
    assert held_out[0] == held_out[1]
    found = ddco_pyro.load(run).metrics.seeds
    assert found.training_seeds == [0, 1, 2]
    assert found.held_out["ddco"][2] == alone.metrics.log_likelihood_per_step.valid
    assert len(set(found.held_out["ddco"])) == 3
    assert found.worth["memory"][2] == pytest.approx(alone.metrics.worth.memory.nats_per_step)


def test_draws_have_a_chain_for_each_training_seed(written):
    fit = ddco_pyro.load(written[1])
    draws = fit.draws(fit.demonstrations, 3)
    assert (draws.seeds, draws.options["option"].shape[:3]) == ((0, 1, 2), (3, 3, 8))
    likelihoods = [again.log_likelihood(fit.demonstrations) for again in (fit, *fit.repetitions)]
    np.testing.assert_array_equal(draws.log_likelihood, likelihoods)


def test_what_is_done_is_not_done_again(written):
    spec, run, _ = written
    before = {path: path.stat().st_mtime_ns for path in (run / "seeds").rglob("model.safetensors")}
    done("fit", spec, "--out", run, "--seeds", 3, "--resume")
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(before) == 6


def test_the_intervals_are_those_of_scipy():
    values = [2.0, 2.5, 1.5, 2.2]
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert words.spread(values) == ("2.05", f"{low:.2f} to {high:.2f}", "1.50 to 2.50")


def test_rollouts_have_the_same_two_parts_and_the_same_seeds(written, tmp_path):
    """The parts are counted again from ``rollouts.csv`` of each repetition."""
    run = shutil.copytree(written[1], tmp_path / "run")
    ended = done("rollout", run, "--episodes", 6, "--jobs", 1)
    found = json.loads((run / "metrics.json").read_text())["rollouts"]
    succeeded = []
    for folder in (run, run / "seeds" / "1", run / "seeds" / "2"):
        rows = list(csv.DictReader((folder / "rollouts.csv").open()))
        names = ("ddco", "mixture", "flat")
        won = {name: [float(row["success"]) for row in rows if row["method"] == name] for name in names}
        succeeded.append({name: sum(own) for name, own in won.items()})
    assert found["seeds"]["success"]["mixture"] == [one["mixture"] / 6 for one in succeeded]
    memory = [(one["ddco"] - one["mixture"]) / 6 for one in succeeded]
    experts = [(one["mixture"] - one["flat"]) / 6 for one in succeeded]
    assert found["seeds"]["worth"]["memory"] == pytest.approx(memory)
    assert found["seeds"]["worth"]["experts"] == pytest.approx(experts)
    own = found["worth"]
    assert (own["memory"]["only_ours"] - own["memory"]["only_theirs"]) / 6 == pytest.approx(memory[0])
    assert verdicts.success(ddco_pyro.load(run).metrics) in ended.out
    page = (run / "report.html").read_text()
    assert 'id="test"' in page
    assert "Points of success, 3 training seeds" in page


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (("demonstrations.valid_fraction=0", "compare_with=[]"), "compares on held-out demonstrations"),
        ((f"training.seed={2**32 - 2}",), "training.seed: must be at most 4294967295"),
    ],
)
def test_what_cannot_be_repeated_is_refused_before_any_work(written, tmp_path, changes, said):
    refused(said, "fit", written[0], "--out", tmp_path / "run", "--seeds", 3, *with_set(*changes))
    assert not (tmp_path / "run").exists()


# --- few demonstrations: each is left out once --------------------------------------------------------------


def few_spec():
    return small_spec(
        demonstrations={"path": "unused.hdf5", "hold_out_by": "demonstration", "labels": "skill"},
        control={"std": {"learn": True, "floor": 0.01, "per_option": True}},
        compare_with=[{"kind": "flat", "policy": LINEAR}],
        training={"optimizer": {"name": "em"}, "epochs": 30, "tune_fraction": 0, "starts": ["vq_controls"]},
    )


def planted(number=4):
    """Two skills one after the other, of opposite controls in different halves of the plane."""
    random, each = np.random.default_rng(3), []
    for n in range(number):
        skill = np.repeat([0, 1], [8 + n, 12 - n])
        state = random.normal(size=(20, 2)) + 2.0 * np.where(skill == 0, -1, 1)[:, None]
        actions = np.where(skill[:, None] == 0, state, -state) + 0.1 * random.normal(size=state.shape)
        each.append(({"state": state}, actions, {"skill": skill}))
    return numbered(each)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return ddco_pyro.fit(few_spec(), planted(), out=tmp_path_factory.mktemp("few") / "run")


def test_every_demonstration_trains_and_is_held_out_from_a_fit_without_it(run):
    demos, counts = planted(), run.metrics.demonstrations
    assert (counts.train, counts.tune, counts.valid, counts.left_out) == (4, 0, 4, True)
    alone = {"demonstrations.hold_out_by": None, "compare_with": []}
    masked, one = replace(demos, masks={"valid": ("demo_0",)}), demos.select(["demo_0"])
    for method, model in (("ddco", run), *run.baselines.items()):
        (held_out,) = (row.log_likelihood for row in model.metrics.valid if row.name == "demo_0")
        # the same held out by a mask instead
        apart = ddco_pyro.fit(with_overrides(model.spec, alone), masked)
        assert held_out == pytest.approx(float(apart.log_likelihood(one)[0])), method
        assert held_out < float(model.log_likelihood(one)[0])  # which the model was fitted to
    spec = with_overrides(run.spec, alone | {"demonstrations.valid_fraction": 0.0})
    everything = ddco_pyro.fit(spec, demos)
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


def test_what_masks_hold_out_is_trained_with():
    masked = replace(planted(), masks={"valid": ("demo_0",)})
    spec = with_overrides(few_spec(), {"training.epochs": 1, "compare_with": []})
    assert ddco_pyro.fit(spec, masked).metrics.demonstrations.train == len(masked)


def test_runs_are_compared_by_what_the_fits_without_one_say(run):
    compared = ddco_pyro.compare([run.folder, run.folder / "baselines" / "flat"])
    each = {row.name: row.each for row in compared.rows}
    assert each[str(run.folder)] == pytest.approx([row.log_likelihood for row in run.metrics.valid])
    assert "each is held out from a fit without it" in verdicts.verdict(run.metrics)
    assert "each held out from a fit without it" in str(training.particulars(run).blocks)
