"""Demonstrations kept by content: what is the same is reused, whatever differs is collected anew."""

from __future__ import annotations

import importlib.metadata
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import toy_task
from scipy import stats

from ddco_pyro.data.demonstrations import Demonstrations, DemonstrationsError
from ddco_pyro.events import DemonstrationsDone
from ddco_pyro.simulation.collect import cache_folder, cache_path, collect
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.spec import DemonstrationsSpec

TASK = "toy_task:task"
SPEC = DemonstrationsSpec(count=5, seed=20)


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("DDCO_PYRO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_the_same_demonstrations_are_collected_once(own_cache):
    told = []
    path = collect(TASK, SPEC, on_event=told.append)
    assert own_cache in path.parents
    assert told == [DemonstrationsDone(done, 5) for done in range(1, 6)]
    before = path.stat()
    assert collect(TASK, SPEC, on_event=told.append) == path
    assert (path.stat().st_mtime_ns, path.stat().st_ino, len(told)) == (before.st_mtime_ns, before.st_ino, 5)


def test_demonstrations_are_the_supervisors_episodes(own_cache):
    read = Demonstrations.read(collect(TASK, SPEC), labels=["phase"])
    assert read.names == tuple(f"demo_{seed}" for seed in range(20, 25))
    for demo, seed in zip(read, range(20, 25), strict=True):
        record = run_episode(toy_task.task, "supervisor", seed).record
        np.testing.assert_array_equal(demo.actions, record.actions)
        np.testing.assert_array_equal(demo.observations["offsets"], record.observations["offsets"])
        np.testing.assert_array_equal(demo.labels["phase"], record.labels["phase"])
        assert demo.attributes == record.attributes


def test_the_supervisors_own_rate_is_stored(own_cache):
    """Of the open-loop plan, because the supervisor hardly ever fails."""
    path = collect(TASK, DemonstrationsSpec(count=12, supervisor="open_loop"))
    stored = json.loads(Demonstrations.read(path).attributes["supervisor"])
    outcomes = [run_episode(toy_task.task, "open_loop", seed).outcome for seed in range(12)]
    successes = int(sum(one["success"] for one in outcomes))
    assert 0 < successes < 12
    interval = stats.binomtest(successes, 12).proportion_ci(method="wilson")
    assert stored["success"] == {
        "successes": successes,
        "trials": 12,
        "rate": successes / 12,
        "interval": [interval.low, interval.high],
    }
    errors = [one["error"] for one in outcomes if not math.isnan(one["error"])]
    assert stored["error"]["trials"] == len(errors)
    assert stored["error"]["mean"] == pytest.approx(np.mean(errors))


@pytest.mark.parametrize(
    "change", [{"count": 6}, {"seed": 21}, {"supervisor": "open_loop"}], ids=["count", "seed", "policy"]
)
def test_other_demonstrations_have_another_file(change):
    one = cache_path(toy_task.task, TASK, SPEC)
    assert cache_path(toy_task.task, TASK, SPEC.model_copy(update=change)) != one
    assert cache_path(toy_task.task, TASK, SPEC.model_copy()) == one


def test_the_split_and_the_labels_do_not_change_the_file():
    other = SPEC.model_copy(update={"valid_fraction": 0.5, "labels": "phase"})
    assert cache_path(toy_task.task, TASK, other) == cache_path(toy_task.task, TASK, SPEC)


def test_changed_sources_have_another_file(tmp_path):
    source = tmp_path / "source.py"
    task = replace(toy_task.task, sources=(source,))
    source.write_text("gain = 1")
    one = cache_path(task, TASK, SPEC)
    source.write_text("gain = 2")
    assert cache_path(task, TASK, SPEC) != one
    source.write_text("gain = 1")
    assert cache_path(task, TASK, SPEC) == one


@pytest.mark.parametrize("package", ["mujoco", "dm-control", "toy-task"])
def test_another_version_of_a_simulator_or_of_the_tasks_package_has_another_file(monkeypatch, package):
    """The toy task is registered by the package ``toy-task``; one that is named by its module has no package."""
    registered, named = cache_path(toy_task.task, "toy", SPEC), cache_path(toy_task.task, TASK, SPEC)
    version = importlib.metadata.version
    other = lambda name: version(name) + ".other" * (name == package)  # noqa: E731
    monkeypatch.setattr(importlib.metadata, "version", other)
    assert cache_path(toy_task.task, "toy", SPEC) != registered
    assert (cache_path(toy_task.task, TASK, SPEC) == named) == (package == "toy-task")


def test_where_the_cache_is(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("DDCO_PYRO_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv("DDCO_PYRO_CACHE")
    assert cache_folder() == tmp_path / "xdg" / "ddco-pyro"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "ddco-pyro"


def test_an_unknown_supervisor_is_refused_in_one_line():
    message = r"^task 'toy' has no policy 'expert' to record \(it has: open_loop, supervisor\)$"
    with pytest.raises(DemonstrationsError, match=message):
        collect(TASK, DemonstrationsSpec(supervisor="expert"))
