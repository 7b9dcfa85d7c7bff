"""Models that are compared have one budget, one of them the same size, and who needed more of it is named."""

import json
import re
from itertools import pairwise

import pytest
import toy_task
import yaml
from command_line import call
from selecting import Told, spec_at

import ddco_pyro
from ddco_pyro.comparison import compare, write
from ddco_pyro.fitting.fit import fit
from ddco_pyro.names import method
from ddco_pyro.selection import Workers, select
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.networks import nearest_widths

BASELINES = ["flat", "flat_equal", "per_timestep"]


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    path = tmp_path_factory.mktemp("specs") / "toy.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(toy_task.SPEC) | {"compare_with": BASELINES}))
    return path


@pytest.fixture(scope="module")
def fitted(spec, tmp_path_factory):
    """A run whose budget is far too small, and how ``fit`` ended."""
    folder = tmp_path_factory.mktemp("runs") / "short"
    ended = call("fit", spec, "--out", folder, "--set", "training.epochs=9")
    return ddco_pyro.load(folder), ended


OWN = {"kind": "flat", "policy": {"hidden": [8]}, "optimizer": {"lr": 0.03}}


def test_a_baseline_beside_trains_as_it_would_alone(toy_spec, tmp_path):
    """What its own optimiser does not say is as in the spec's."""
    shared = {"training.optimizer.weight_decay": 0.01, "training.epochs": 4}
    own = with_overrides(toy_spec, shared | {"compare_with": [OWN]})
    beside = fit(own, out=tmp_path / "beside").baselines["flat"]
    alone = {"hierarchy": None, "baseline": {**OWN, "optimizer": None}, "compare_with": []}
    spec = with_overrides(toy_spec, shared | alone | {"training.optimizer.lr": 0.03})
    apart = fit(spec, out=tmp_path / "alone").metrics
    assert beside.metrics.log_likelihood_per_step == apart.log_likelihood_per_step
    assert beside.spec.training == spec.training


def perceptron(hidden, inputs=5, outputs=2):
    """Weights and biases of a perceptron, counted by hand."""
    return sum((below + 1) * above for below, above in pairwise([inputs, *hidden, outputs]))


@pytest.mark.parametrize("hidden", [(64,), (64, 32), (8, 64), (1,), (3, 3, 3)])
def test_widths_are_the_nearest_of_all(hidden):
    """Of every width that the widest layer can have, the others in proportion."""
    widest = max(hidden)
    scales = [width / widest for width in range(1, 20_000)]
    candidates = [tuple(max(1, round(size * scale)) for size in hidden) for scale in scales]
    counts = [perceptron(sizes) for sizes in candidates]
    for target in (1, 8, 37, 300, 5000, 123_456):
        nearest = min(range(len(counts)), key=lambda n: abs(counts[n] - target))
        assert nearest_widths(hidden, target, perceptron) == candidates[nearest]


def test_flat_equal_has_as_many_parameters_as_the_hierarchy(fitted):
    run, _ = fitted
    count, options = 8, 2
    policies = options * perceptron((count,))
    ours = policies + options * perceptron((), outputs=1) + perceptron((count,), outputs=options)
    width = min(range(1, 1000), key=lambda h: abs(perceptron((h,)) - ours))
    equal = run.baselines["flat_equal"]
    assert run.metrics.parameters == ours
    assert equal.metrics.parameters == run.metrics.comparison["flat_equal"].parameters == perceptron((width,))
    assert abs(perceptron((width,)) - ours) <= 4  # a unit has 8
    assert equal.spec.baseline.policy.hidden == (width,)
    assert equal.spec.baseline.kind == equal.name == "flat_equal"


def test_every_method_has_the_same_budget(fitted):
    """Eight training demonstrations in minibatches of three: three gradient steps in an epoch."""
    metrics = fitted[0].metrics
    for training in metrics.trainings.values():
        assert dict(training.budget) == dict(training.spent) == {"epochs": 9, "gradient_steps": 27}
    assert [stage.cap for stage in metrics.training.stages] == [2, 2, 2, 3]


def test_candidates_of_a_selection_have_the_same_budget(tmp_path):
    """One level of options or two: four stages or six."""
    level = {"count": 2, "policy": {"network": "linear"}, "termination": {"network": "linear"}}
    upper = {**level, "name": "upper", "policy": {"network": "linear", "emits": ["options"]}}
    grid = {"hierarchy.levels": [[level], [level, upper]], "training.epochs": [13]}
    spec = spec_at(tmp_path, folds=2, grid=grid)
    found = select(spec, tmp_path / "run", Told(), Workers(1))
    # five to train with are one minibatch
    assert [row.gradient_steps for row in found.choice.rows] == [13.0, 13.0]
    assert [len(row.unconverged) for row in found.choice.rows] == [2, 2]  # in both folds


def test_stages_that_needed_more_are_named_on_the_console(fitted):
    run, ended = fitted
    said = " ".join(ended.out.split())
    for name, training in run.metrics.trainings.items():
        assert not training.converged
        assert re.search(rf" {method(name)} │[^┃]*│ 27, not converged ", said)
        for stage in training.stages:
            rise = f"{stage.rising:.2f} nats per step over the last {stage.epochs})"
            ended = f"stage {stage.stage} after {stage.epochs} epochs"
            assert f"{ended} (tuning log-likelihood up by {rise}" in said
    assert said.count("warning: ") >= 4
    assert "warning: Options have not converged: the budget ended stage vq-1 after 2 epochs" in said
    policy = "Flat of equal size has not converged: the budget ended stage policy after 9 epochs"
    assert f"warning: {policy}" in said


def test_a_comparison_marks_them(fitted, tmp_path):
    run, _ = fitted
    found = compare([run.folder, run.folder / "baselines" / "flat"])
    text = (write(found, tmp_path / "comparison").parent / "compare.md").read_text()
    assert text.count("| 27, not converged |") == 2
    assert "Not converged: more epochs may change the rank of such a run." in text
    data = json.loads((tmp_path / "comparison" / "compare.json").read_text())
    assert [row["training"]["converged"] for row in data["rows"]] == [False, False]
    assert (tmp_path / "comparison" / "compare.html").read_text().count("27, not converged") == 2
