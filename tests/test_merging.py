"""Two options made one: which, what the fit begins from, and that a planted option is found in place of its halves."""

from __future__ import annotations

import copy
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from command_line import call
from planted import CONTROL, make_spec, make_truth, plant
from sklearn.metrics import normalized_mutual_info_score

import ddco_pyro
from ddco_pyro.data.demonstrations import Demonstrations
from ddco_pyro.drawing import words
from ddco_pyro.fitting.merging import LABELS, MergeError, Pair, chosen, merge, merged_labels, merged_spec
from ddco_pyro.metrics import Metrics
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.data import parts

SETTINGS = {"epochs": 300, "patience": 15, "starts": ["vq_controls"]}


@pytest.fixture(scope="module")
def planted():
    """A fit with an option more than the two that the demonstrations were drawn from; and the true options, by name."""
    truth = make_truth(make_spec((2,), control=CONTROL))
    demos, choices = plant(truth, 40, 25, seed=1)
    run = ddco_pyro.fit(make_spec((3,), control=CONTROL, **SETTINGS), demos)
    return run, {demo.name: own for demo, own in zip(demos, choices[..., 0].numpy(), strict=True)}


def table(run, truth):
    """Steps of each option (rows) with each true one (columns), held out."""
    valid = parts(run.spec, run.demonstrations)["valid"]
    found = np.concatenate(run.segment(valid)[0])
    true = np.concatenate([truth[demo.name][: len(demo)] for demo in valid])
    return found, true


def test_the_halves_of_a_planted_option_are_found_and_made_one(planted):
    run, truth = planted
    pair = chosen(run)
    found, true = table(run, truth)
    halves = [np.bincount(true[found == option]).argmax() for option in pair.options]
    assert halves[0] == halves[1]
    merged = merge(run, pair)
    assert merged.spec.hierarchy.levels[0].count == 2
    found, true = table(merged, truth)
    assert normalized_mutual_info_score(true, found) > 0.95
    before, after = (one.metrics.log_likelihood_per_step.valid for one in (run, merged))
    assert after > before - 0.05


@pytest.mark.parametrize(
    ("options", "labels"), [((1, 3), [0, 1, 0, -1, 1]), ((1, 2), [0, 0, 1, -1, 0]), ((2, 3), [0, 1, 1, -1, 1])]
)
def test_what_training_begins_from(planted, monkeypatch, options, labels):
    """Options 1, 2, 3, the caller itself, and 2 again."""
    run, _ = planted
    demo = run.demonstrations[0]
    short = {key: seen[:5] for key, seen in demo.observations.items()}
    demos = Demonstrations((replace(demo, observations=short, actions=demo.actions[:5], labels={}),))
    monkeypatch.setattr(type(run), "segment", lambda self, demos: ([np.array([1, 2, 3, 0, 2])],))
    (labelled,) = merged_labels(replace(run, given=demos), Pair(0, options, None))
    assert labelled.labels[LABELS].tolist() == labels


def with_divergences(run, rows):
    return replace(run, metrics=Metrics.model_validate(run.metrics.model_dump() | {"divergences": [rows]}))


def test_the_pair_that_acts_most_alike_is_meant(planted):
    run, _ = planted
    rows = [{"options": [1, 2], "divergence": 0.4}, {"options": [1, 3], "divergence": None},
            {"options": [2, 3], "divergence": 0.3}]  # fmt: skip
    told = with_divergences(run, rows)
    assert chosen(told) == Pair(0, (2, 3), 0.3)
    assert chosen(told, "level-1", (3, 1)) == Pair(0, (1, 3), None)
    with pytest.raises(MergeError, match=r"^this fit: no two options of level 'level-1' are used"):
        chosen(with_divergences(run, [row | {"divergence": None} for row in rows]))


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--options", 2, 2), "options 2 and 2 of level 'option': give two different ones from 1 to 2"),
        (("--options", 0, 1), "options 0 and 1 of level 'option': give two different ones from 1 to 2"),
        (("--level", "opton"), "there is no level 'opton' (did you mean 'option'?); there is: option"),
    ],
)
def test_what_cannot_be_merged_is_one_line(toy_run, tmp_path, options, problem):
    ended = call("merge", toy_run.folder, "--out", tmp_path / "out", *options)
    assert (ended.status, ended.err.count("\n")) == (2, 1)
    assert problem in ended.err
    assert not (tmp_path / "out").exists()


def test_a_baseline_has_nothing_to_merge(toy_run):
    with pytest.raises(MergeError, match=r"flat: is a policy without options; there are none to merge$"):
        chosen(toy_run.baselines["flat"])


def test_a_level_of_one_option_and_options_with_names_stay(toy_spec):
    with pytest.raises(MergeError, match=r"^level 'option' has one option"):
        merged_spec(with_overrides(toy_spec, {"hierarchy.levels.0.count": 1}), 0)
    held = {"training.labels": {"level": "option", "from": "phase"}}
    with pytest.raises(MergeError, match=r"^training\.labels says which options there are; join two of the labels"):
        merged_spec(with_overrides(toy_spec, held), 0)


def test_a_folder_is_of_one_pair_and_one_run(planted, tmp_path):
    run, _ = planted
    quick = replace(run, spec=with_overrides(run.spec, {"training.epochs": 2}))
    first = merge(quick, chosen(quick, options=(2, 3)), out=tmp_path / "merged")
    again = merge(quick, chosen(quick, options=(3, 2)), out=tmp_path / "merged")
    assert again.metrics == first.metrics
    before = {path: path.read_bytes() for path in (tmp_path / "merged").rglob("*") if path.is_file()}
    with pytest.raises(MergeError, match=r"merged: holds options 2 and 3 of level 'level-1', merged; choose another"):
        merge(quick, chosen(quick, options=(1, 3)), out=tmp_path / "merged")
    other = replace(quick, hierarchy=copy.deepcopy(run.hierarchy))
    with torch.no_grad():
        other.hierarchy.meta_policy.network.layers[0].bias += 1e-3
    with pytest.raises(MergeError, match=r"merged: holds options of another run, merged; choose another --out"):
        merge(other, chosen(quick, options=(2, 3)), out=tmp_path / "merged")
    demos = Demonstrations.read(tmp_path / "merged" / "demonstrations.hdf5", labels=[LABELS])
    assert {path: path.read_bytes() for path in before} == before
    replace(demos, attributes={}).write(tmp_path / "merged" / "demonstrations.hdf5")
    with pytest.raises(MergeError, match=r"merged: does not say which options it merged; choose another --out"):
        merge(quick, chosen(quick, options=(2, 3)), out=tmp_path / "merged")


@pytest.mark.slow
def test_the_command_writes_a_run_and_goes_on_where_it_was(toy_run, tmp_path):
    arguments = ("merge", toy_run.folder, "--out", tmp_path / "merged", "--jobs", 1)
    ended = call(*arguments)
    assert ended.status == 0, ended.err
    values = [run.metrics.log_likelihood_per_step.valid for run in (toy_run, ddco_pyro.load(tmp_path / "merged"))]
    said = " ".join(ended.out.split())
    before, after = map(words.number, values)
    assert re.search(
        rf"Merged options .*1\)? and .*2\)? \([\d.]+ nats/step apart\): held-out {before} → {after} nats/step", said
    )
    spec = yaml.safe_load((tmp_path / "merged" / "spec.yaml").read_text())
    assert spec["hierarchy"]["levels"][0]["count"] == 1
    assert spec["training"]["labels"] == {"level": "option", "from": LABELS, "count": None, "hold": False}
    written = (tmp_path / "merged" / "metrics.json").read_bytes()
    assert call(*arguments).status == 0
    assert (tmp_path / "merged" / "metrics.json").read_bytes() == written
    compared = call("compare", toy_run.folder, tmp_path / "merged", "--out", tmp_path / "compared")
    assert compared.status == 0, compared.err  # both held the same demonstrations out
