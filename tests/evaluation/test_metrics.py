"""What ``metrics.json`` says, against sums of the models' own log-likelihoods; and that it is JSON."""

import json
import pickle

import numpy as np
import pytest
from planted import small_spec

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstration, Demonstrations
from ddco_pyro.data.files import json_text
from ddco_pyro.evaluation import verdicts
from ddco_pyro.metrics import Metrics
from ddco_pyro.report import write_report
from ddco_pyro.training.data import train_and_valid


def demonstrations(number):
    """Of different lengths; the control bends, which a linear policy cannot follow."""
    random, each = np.random.default_rng(0), []
    for n in range(number):
        seen = random.uniform(-2, 2, size=(6 + n, 1))
        controls = np.abs(seen) + 0.1 * random.normal(size=seen.shape)
        each.append(Demonstration(f"demo_{n}", {"state": seen}, controls))
    return Demonstrations(tuple(each))


def make_spec(counts, valid_fraction, compare_with):
    known = {"path": "unused.hdf5", "valid_fraction": valid_fraction}
    training = {"epochs": 30, "optimizer": {"lr": 0.03}, "starts": ["random"]}
    mlp = {"network": "mlp", "hidden": [4]}
    return small_spec(counts, mlp, demonstrations=known, training=training, compare_with=compare_with)


def strictly(text):
    """JSON as it is defined, without NaN and infinities."""

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_a_baseline_of_the_models_own_kind_has_numbers_of_its_own(tmp_path):
    """``flat`` with hidden units, and beside it a linear ``flat``, both by their own log-likelihoods."""
    linear = {"kind": "flat", "policy": {"network": "linear"}}
    spec = make_spec((), 0.4, [linear, linear])
    demos = demonstrations(10)
    run = ddco_pyro.fit(spec, demos, out=tmp_path / "run")
    valid = train_and_valid(spec, demos)["valid"]
    steps = sum(valid.lengths)
    ours = run.log_likelihood(valid)
    assert list(run.metrics.comparison) == list(run.baselines) == ["flat_2", "flat_3"]
    assert run.metrics.log_likelihood_per_step.valid == pytest.approx(ours.sum() / steps)
    for name, beside in run.baselines.items():
        theirs, said = beside.log_likelihood(valid), run.metrics.comparison[name]
        assert abs(ours.sum() - theirs.sum()) / steps > 0.1  # or this could not tell one from the other
        assert said.log_likelihood_per_step.valid == pytest.approx(theirs.sum() / steps)
        assert said.difference.nats_per_step == pytest.approx((ours.sum() - theirs.sum()) / steps)
    listed = {row.name: row.log_likelihood_per_step for row in run.metrics.demonstrations_by_likelihood}
    for name, value, length in zip(valid.names, ours, valid.lengths, strict=True):
        assert listed[name]["flat"] == pytest.approx(value / length)
    assert list(ddco_pyro.load(tmp_path / "run").baselines) == ["flat_2", "flat_3"]


def test_a_single_held_out_demonstration_has_no_error_and_every_file_is_json(tmp_path):
    spec = make_spec((2,), 0.1, ["flat"])
    run = ddco_pyro.fit(spec, demonstrations(6), out=tmp_path / "run")
    again = ddco_pyro.load(tmp_path / "run")
    read = strictly((tmp_path / "run" / "metrics.json").read_text())
    for metrics in (run.metrics, again.metrics, Metrics.model_validate(read)):
        assert metrics.comparison["flat"].difference.standard_error is None
        assert pickle.loads(pickle.dumps(metrics)) == metrics  # processes hand it over
    assert "(1 held-out demonstration is too few for an error" in verdicts.verdict(run.metrics)
    page = write_report(run, run.demonstrations).read_text()
    assert "± –" in page


def test_json_has_null_for_what_is_no_number():
    data = {"a": [1.5, float("nan"), (2, None)], "b": {"c": float("nan")}}
    assert strictly(json_text(data)) == {"a": [1.5, None, [2, None]], "b": {"c": None}}
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_text([float("inf")])
