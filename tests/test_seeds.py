"""A fit repeated with other training seeds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import call
from random_demonstrations import demonstrations
from scipy import stats

import ddco_pyro
from ddco_pyro.drawing import words
from ddco_pyro.fitting.seeds import over_seeds, training_seeds
from ddco_pyro.spec import load_spec, with_overrides

SPEC = {
    "observations": ["pose"],
    "hierarchy": {"levels": [{"count": 2, "policy": {"network": "linear"}}], "meta_policy": {"network": "linear"}},
    "compare_with": [{"kind": "flat", "policy": {"network": "linear"}}, "mixture"],
    "training": {"epochs": 4, "initialize": "random", "layerwise": False},
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A spec and a run of it with three training seeds, by the command, and how that ended."""
    folder = tmp_path_factory.mktemp("seeds")
    demonstrations(8).write(folder / "demos.hdf5")
    spec = folder / "spec.yaml"
    spec.write_text(yaml.safe_dump(SPEC | {"demonstrations": {"path": str(folder / "demos.hdf5")}}))
    return spec, folder / "run", call("fit", spec, "--out", folder / "run", "--seeds", 3, "--jobs", 1)


def test_each_repetition_is_that_fit_with_another_training_seed(written):
    spec, run, ended = written
    assert ended.status == 0, ended.err
    assert sorted(path.name for path in (run / "seeds").iterdir()) == ["1", "2"]
    alone = ddco_pyro.fit(with_overrides(load_spec(spec), {"training.seed": 2}))
    again = ddco_pyro.load(run / "seeds" / "2")
    for name in ("flat", "mixture"):
        assert (
            again.baselines[name].metrics["log_likelihood_per_step"]
            == (alone.baselines[name].metrics["log_likelihood_per_step"])
        )
    held_out = [[row["name"] for row in ddco_pyro.load(path).metrics["valid"]] for path in (run, run / "seeds" / "1")]
    assert held_out[0] == held_out[1]
    found = ddco_pyro.load(run).metrics["seeds"]
    assert found["training_seeds"] == [0, 1, 2]
    assert found["held_out"]["ddco"][2] == alone.metrics["log_likelihood_per_step"]["valid"]
    assert len(set(found["held_out"]["ddco"])) == 3
    assert found["worth"]["memory"][2] == pytest.approx(alone.metrics["worth"]["memory"]["nats_per_step"])


def test_the_command_says_how_much_they_differ(written):
    _, run, ended = written
    metrics = json.loads((run / "metrics.json").read_text())
    assert words.over_seeds(metrics["seeds"], "DDCO") in ended.out
    assert "--seeds" not in ended.out  # nothing more is asked for
    assert words.over_seeds(metrics["seeds"], "DDCO") in (run / "report.html").read_text().replace("&#39;", "'")


def test_what_is_done_is_not_done_again(written):
    spec, run, _ = written
    before = {path: path.stat().st_mtime_ns for path in (run / "seeds").rglob("model.safetensors")}
    ended = call("fit", spec, "--out", run, "--seeds", 3, "--resume")
    assert ended.status == 0, ended.err
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert len(before) == 6


@pytest.mark.slow
def test_processes_change_no_number(written, tmp_path):
    spec, run, _ = written
    assert call("fit", spec, "--out", tmp_path / "run", "--seeds", 3, "--jobs", 2).status == 0
    both = [json.loads((folder / "metrics.json").read_text())["seeds"] for folder in (run, tmp_path / "run")]
    assert both[0] == both[1]


def test_the_intervals_are_those_of_scipy():
    values = [2.0, 2.5, 1.5, 2.2]
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert words.spread(values) == ("2.05", f"{low:.2f} to {high:.2f}", "1.50 to 2.50")


@pytest.mark.parametrize(
    ("memory", "said"),
    [
        ([0.3, 0.4, 0.35], "So options that last are worth it on these demonstrations."),
        ([0.3, 0.4, -0.35], "So it is inconclusive whether options that last are worth anything here."),
        ([-0.3, -0.4, -0.35], "So options that last explain these demonstrations worse than the same experts"),
    ],
)
def test_the_verdict_is_over_training_seeds(memory, said):
    text = words.over_seeds({"training_seeds": [0, 1, 2], "held_out": {}, "worth": {"memory": memory}}, "DDCO")
    assert said in text


def test_seeds_follow_the_specs_own(written):
    spec = load_spec(written[0])
    assert training_seeds(spec, 2) == [0, 1]
    assert training_seeds(with_overrides(spec, {"training.seed": 7}), 3) == [7, 8, 9]


def test_a_run_without_a_mixture_has_no_parts():
    metrics = {"model": "ddco", "log_likelihood_per_step": {"train": 1.0, "valid": 0.5}, "comparison": {}}
    found = over_seeds([0, 1], [metrics, metrics])
    assert found == {"training_seeds": [0, 1], "held_out": {"ddco": [0.5, 0.5]}, "worth": {}}
    assert words.over_seeds(found, "DDCO") == "Over 2 training seeds, with the same demonstrations held out."


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["--set", "demonstrations.valid_fraction=0", "--set", "compare_with=[]"],
            "compares on held-out demonstrations",
        ),
        (["--set", f"training.seed={2**32 - 2}"], "training.seed: must be at most 4294967295"),
    ],
)
def test_what_cannot_be_repeated_is_refused_before_any_work(written, tmp_path, arguments, said):
    ended = call("fit", written[0], "--out", tmp_path / "run", "--seeds", 3, *arguments)
    assert ended.status == 2
    assert said in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not Path(tmp_path / "run").exists()
