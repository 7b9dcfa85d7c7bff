"""Rollouts of a run against its own table, episode by episode."""

import csv
import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import toy_task

import ddco_pyro
from ddco_pyro.errors import BadInput
from ddco_pyro.fitting.rollouts import policies, roll_out
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import with_overrides

METHODS = ["open_loop", "supervisor", "flat", "per_timestep", "ddco"]
EPISODES, FIRST = 6, 1000


@pytest.fixture(scope="module")
def rolled(toy_run, tmp_path_factory):
    """A copy of the run, rolled out and filmed; what was returned, and what was told on the way."""
    told = []
    run = ddco_pyro.load(shutil.copytree(toy_run.folder, tmp_path_factory.mktemp("rolled") / "run"))
    before = json.loads((run.folder / "metrics.json").read_text())
    results = roll_out(run, EPISODES, film=2, on_event=told.append, jobs=1)
    return run, results, told, before


@pytest.fixture(scope="module")
def rows(rolled):
    run, *_ = rolled
    return list(csv.DictReader((run.folder / "rollouts.csv").open()))


def values(rows, method, measure):
    return [float(row[measure]) for row in rows if row["method"] == method]


def test_every_method_starts_from_the_same_states(rows):
    assert list(dict.fromkeys(row["method"] for row in rows)) == METHODS
    for method in METHODS:
        seeds = [int(row["seed"]) for row in rows if row["method"] == method]
        assert seeds == list(range(FIRST, FIRST + EPISODES))


def test_the_table_is_what_the_episodes_gave(rolled, rows):
    run, *_ = rolled
    acting = {"open_loop": "open_loop", "supervisor": "supervisor", "ddco": run.controller()}
    acting |= {name: fit.controller() for name, fit in run.baselines.items()}
    for row in rows:
        episode = run_episode(toy_task.task, acting[row["method"]], int(row["seed"]))
        np.testing.assert_equal({key: float(row[key]) for key in ("success", "error")}, episode.outcome)


def test_metrics_can_be_computed_again_from_the_table(rolled, rows):
    run, results, _, before = rolled
    metrics = json.loads((run.folder / "metrics.json").read_text())
    assert metrics == before | {"rollouts": results.model_dump(mode="json")}
    assert (results.seed, results.episodes, list(results.methods)) == (FIRST, EPISODES, METHODS)
    ours = values(rows, "ddco", "success")
    for method, found in results.methods.items():
        successes, errors = values(rows, method, "success"), values(rows, method, "error")
        applies = [error for error in errors if not math.isnan(error)]
        success, error = found.measures["success"], found.measures["error"]
        assert (success.successes, success.trials) == (sum(successes), EPISODES)
        assert error.trials == len(applies)
        assert not applies or error.mean == pytest.approx(np.mean(applies))
        if method == "ddco":
            assert found.against is None
            continue
        wins = sum(a > b for a, b in zip(ours, successes, strict=True))
        losses = sum(a < b for a, b in zip(ours, successes, strict=True))
        assert (found.against.only_ours, found.against.only_theirs) == (wins, losses)


def test_the_first_episodes_of_each_method_are_filmed(rolled):
    run, *_ = rolled
    films = {path.name for path in (run.folder / "videos").iterdir()}
    assert films == {f"{method}-{seed}.mp4" for method in METHODS for seed in (FIRST, FIRST + 1)}


def changed(run, **changes):
    return replace(run, spec=with_overrides(run.spec, changes))


def test_an_unknown_scripted_policy_is_refused(toy_run):
    message = r"^rollout\.policies: task 'toy' has no expert \(it has: supervisor, open_loop\)$"
    with pytest.raises(BadInput, match=message):
        policies(changed(toy_run, **{"rollout.policies": ["open_loop", "expert"]}))


def test_a_run_without_a_task_cannot_be_rolled_out(toy_run):
    with pytest.raises(BadInput, match=r"toy: its spec has no task, so there is nothing to roll out in$"):
        policies(changed(toy_run, task=None, **{"demonstrations.path": "demos.hdf5"}))


@pytest.fixture
def copied(rolled, tmp_path):
    """A copy of the run with its rollouts."""
    run, *_ = rolled
    return ddco_pyro.load(shutil.copytree(run.folder, tmp_path / "copied"))


def refuse(*arguments):
    raise AssertionError(f"rolled out: {arguments[1]}")


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_rollouts_that_the_run_holds_are_not_done_again_if_asked(copied, rolled, monkeypatch):
    _, results, *_ = rolled
    before = contents(copied.folder)
    monkeypatch.setattr("ddco_pyro.fitting.rollouts.run_episodes", refuse)
    assert roll_out(copied, EPISODES, 2, refuse, jobs=1, resume=True) == results
    assert contents(copied.folder) == before


@pytest.mark.parametrize(
    ("episodes", "film", "resume"), [(EPISODES, 2, False), (EPISODES - 1, 2, True), (EPISODES, 3, True)]
)
def test_others_are(copied, monkeypatch, episodes, film, resume):
    monkeypatch.setattr("ddco_pyro.fitting.rollouts.run_episodes", refuse)
    with pytest.raises(AssertionError, match=f"rolled out: {METHODS[0]}"):
        roll_out(copied, episodes, film, jobs=1, resume=resume)
