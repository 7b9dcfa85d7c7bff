"""Rollouts of a run against its own table, episode by episode."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections import Counter

import numpy as np
import pytest
import toy_task

import ddco_pyro
from ddco_pyro.evaluate import policies, roll_out
from ddco_pyro.rollout import run_episode
from ddco_pyro.run import Fit, RunError
from ddco_pyro.spec import with_overrides

METHODS = ["open_loop", "supervisor", "flat", "per_timestep", "ddco"]
EPISODES, FIRST = 6, 1000


@pytest.fixture(scope="module")
def rolled(toy_run, tmp_path_factory):
    """A copy of the run, rolled out and filmed; what was returned, and what was told on the way."""
    told = []
    run = ddco_pyro.load(shutil.copytree(toy_run.folder, tmp_path_factory.mktemp("rolled") / "run"))
    before = run.metrics
    results = roll_out(run, EPISODES, film=2, on_episode=told.append, jobs=1)
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


def test_progress_is_told_for_every_episode(rolled):
    *_, told, _ = rolled
    assert Counter(told) == dict.fromkeys(METHODS, EPISODES)


def test_metrics_can_be_computed_again_from_the_table(rolled, rows):
    run, results, _, before = rolled
    metrics = json.loads((run.folder / "metrics.json").read_text())
    assert metrics == before | {"rollouts": results}
    assert (results["seed"], results["episodes"], list(results["methods"])) == (FIRST, EPISODES, METHODS)
    ours = values(rows, "ddco", "success")
    for method, found in results["methods"].items():
        successes, errors = values(rows, method, "success"), values(rows, method, "error")
        applies = [error for error in errors if not math.isnan(error)]
        success, error = found["measures"]["success"], found["measures"]["error"]
        assert (success["successes"], success["trials"]) == (sum(successes), EPISODES)
        assert error["trials"] == len(applies)
        assert not applies or error["mean"] == pytest.approx(np.mean(applies))
        if method == "ddco":
            assert "against" not in found
            continue
        wins = sum(a > b for a, b in zip(ours, successes, strict=True))
        losses = sum(a < b for a, b in zip(ours, successes, strict=True))
        assert (found["against"]["only_ours"], found["against"]["only_theirs"]) == (wins, losses)


def test_the_first_episodes_of_each_method_are_filmed(rolled):
    run, *_ = rolled
    films = {path.name for path in (run.folder / "videos").iterdir()}
    assert films == {f"{method}-{seed}.mp4" for method in METHODS for seed in (FIRST, FIRST + 1)}


def test_rolling_out_again_gives_the_same(rolled, toy_run, tmp_path):
    run, results, *_ = rolled
    again = ddco_pyro.load(shutil.copytree(toy_run.folder, tmp_path / "again"))
    roll_out(again, EPISODES, film=0, on_episode=lambda name: None, jobs=2)
    assert (again.folder / "rollouts.csv").read_bytes() == (run.folder / "rollouts.csv").read_bytes()
    assert again.metrics["rollouts"] == results
    assert not (again.folder / "videos").exists()


def changed(run, **changes):
    return Fit(run.folder, with_overrides(run.spec, changes), run.hierarchy)


def test_an_unknown_scripted_policy_is_refused(toy_run):
    message = r"^rollout\.policies: task 'toy' has no expert \(it has: supervisor, open_loop\)$"
    with pytest.raises(RunError, match=message):
        policies(changed(toy_run, **{"rollout.policies": ["open_loop", "expert"]}))


def test_a_run_without_a_task_cannot_be_rolled_out(toy_run):
    with pytest.raises(RunError, match=r"toy: its spec has no task, so there is nothing to roll out in$"):
        policies(changed(toy_run, task=None, **{"demonstrations.path": "demos.hdf5"}))
