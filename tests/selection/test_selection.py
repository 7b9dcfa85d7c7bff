"""A whole selection: scores against fits by hand, nothing done twice, and one result however it was run."""

import json
from xml.etree import ElementTree

import joblib
import numpy as np
import pytest
from selecting import Told, kept, spec_at, two_skills

from ddco_pyro import selection
from ddco_pyro.errors import Failed
from ddco_pyro.fitting.fitted import Fit
from ddco_pyro.selection import Workers, final_spec, select
from ddco_pyro.spec import with_overrides
from ddco_pyro.training.networks import Dimensions
from ddco_pyro.training.restarts import train_model

ONE = Workers(1)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A selection over two candidates and three folds: its spec, folder, result, and what was told."""
    folder = tmp_path_factory.mktemp("selection")
    spec, told = with_overrides(spec_at(folder, folds=3), {"training.starts": ["vq", "vq"]}), Told()
    return spec, folder / "run", select(spec, folder / "run", told, ONE), told


def test_a_score_is_that_of_a_fit_without_the_fold(finished):
    """Nothing that training sees, tuning and restarts included, comes from the fold that is scored."""
    _, folder, made, _ = finished
    demos = two_skills()
    scores = kept(folder)
    for row in made.choice.rows:
        names = made.held_out[2]
        rest = demos.select([name for name in demos.names if name not in names])
        trained = train_model(row.candidate.spec, Dimensions.of(demos), rest)
        expected = Fit(row.candidate.spec, trained.hierarchy).log_likelihood(demos.select(names))
        found = [demo.log_likelihood for demo in scores[row.candidate.number, 2].valid]
        np.testing.assert_array_equal(found, expected)


def test_every_candidate_has_the_same_folds(finished):
    _, folder, made, told = finished
    scores = kept(folder)
    assert set(scores) == {(c, f) for c in range(2) for f in range(3)}
    for (_, fold), one in scores.items():
        assert tuple(demo.name for demo in one.valid) == tuple(made.held_out[fold])
        lengths = [len(demo) for demo in two_skills().select(made.held_out[fold])]
        assert [demo.steps for demo in one.valid] == lengths
    assert told.begun == [("cross-validation", 6, 0)]
    assert {pair[0] for pair in told.pairs} == {
        f"{row.candidate.name}, fold {f}" for row in made.choice.rows for f in range(3)
    }


def test_the_file_is_what_the_scores_say(finished):
    _, folder, made, _ = finished
    data = json.loads((folder / "selection.json").read_text())
    scores, means = kept(folder), []
    for row in data["candidates"]:
        own = [demo for fold in range(3) for demo in scores[row["number"], fold].valid]
        means.append(sum(demo.log_likelihood for demo in own) / sum(demo.steps for demo in own))
        assert row["log_likelihood_per_step"] == pytest.approx(means[-1])
        assert row["status"] == "scored"
    assert data["best"] == int(np.argmax(means)) == made.choice.best.candidate.number
    assert data["chosen"] == made.choice.chosen.candidate.number
    assert (data["folds"], data["demonstrations"]) == (3, 12)
    assert ElementTree.parse(folder / "figures" / "selection.svg").getroot().get("aria-label")
    assert made.choice.chosen.candidate.name in (folder / "selection.md").read_text()


def test_what_is_there_is_not_done_again(finished, monkeypatch):
    spec, folder, made, _ = finished
    before = (folder / "selection.json").read_bytes()
    monkeypatch.setattr(selection, "fit_beside", None)
    told = Told()
    again = select(spec, folder, told, ONE)
    assert (told.begun, told.pairs) == ([("cross-validation", 6, 6)], [])
    assert (folder / "selection.json").read_bytes() == before
    assert again.choice == made.choice


def test_the_final_fit_is_on_all_the_data(finished):
    _, _, made, _ = finished
    final = final_spec(made.choice.chosen.candidate)
    assert final.demonstrations.valid_fraction == 0
    assert final.hierarchy.levels[0].count == made.choice.chosen.candidate.values["hierarchy.levels.0.count"]
    assert final.selection.grid == {}


def test_a_fold_that_fails_is_named_and_the_others_go_on(tmp_path, monkeypatch):
    grid = {"training.optimizer.lr": [0.05, 1e30], "training.patience": [None], "training.epochs": [16]}
    spec = spec_at(tmp_path, grid=grid, folds=2)
    told = Told()
    made = select(spec, tmp_path / "run", told, ONE)
    assert made.choice.chosen.candidate.number == made.choice.best.candidate.number == 0
    failed = made.choice.rows[1].failed
    assert sorted(failed) == [0, 1]
    assert all("is not finite" in reason for reason in failed.values())
    data = json.loads((tmp_path / "run" / "selection.json").read_text())
    assert [(one["candidate"], one["fold"]) for one in data["failed"]] == [(1, 0), (1, 1)]
    assert {pair[1] for pair in told.pairs if pair[0].startswith("lr = 0.05")} == {""}


def test_where_nothing_is_left_an_unexpected_error_is_told_and_tried_again_next_time(tmp_path, monkeypatch):
    spec = spec_at(tmp_path, grid={"hierarchy.levels.0.count": [2]}, folds=2)
    monkeypatch.setattr(selection, "fit_beside", lambda *_, **__: 1 / 0)
    said = "every candidate has failed in some fold; the first reason: unexpected ZeroDivisionError: "
    said += "division by zero"
    with pytest.raises(Failed, match=said):
        select(spec, tmp_path / "run", Told(), ONE)
    assert json.loads((tmp_path / "run" / "selection.json").read_text())["chosen"] is None
    monkeypatch.undo()
    assert select(spec, tmp_path / "run", Told(), ONE).choice.chosen is not None


@pytest.mark.slow
def test_a_cluster_of_dask_gives_the_same(tmp_path):
    """Two worker processes of a real scheduler."""
    distributed = pytest.importorskip("distributed")
    spec, size = spec_at(tmp_path), {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.Client(**size, local_directory=tmp_path / "dask"), joblib.parallel_config("dask"):
        select(spec, tmp_path / "cluster", Told())
    select(spec, tmp_path / "here", Told(), ONE)
    for name in ("selection.json", "folds.json"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()
    there, here = kept(tmp_path / "cluster"), kept(tmp_path / "here")
    assert there.keys() == here.keys()
    assert all(there[key].valid == here[key].valid for key in here)
