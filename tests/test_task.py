"""How a task is found, and the toy task itself."""

from __future__ import annotations

import numpy as np
import pytest
import toy_task

from ddco_pyro.rollout import run_episode
from ddco_pyro.spec.types import TASKS
from ddco_pyro.task import UnknownTask, find_task

not_a_task = "text"


def test_a_task_is_found_by_module_and_name():
    assert find_task("toy_task:task") is toy_task.task


def test_a_registered_task_is_found_by_its_name(monkeypatch):
    class Point:
        name = "toy"

        @staticmethod
        def load():
            return toy_task.task

    def entry_points(group):
        assert group == TASKS
        return [Point]

    monkeypatch.setattr("ddco_pyro.task.entry_points", entry_points)
    assert find_task("toy") is toy_task.task
    with pytest.raises(
        UnknownTask, match=r"^no task is registered as 'toi' \(registered: toy\); module:name works too$"
    ):
        find_task("toi")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module:task", "^task 'no_such_module:task' cannot be loaded: No module named 'no_such_module'$"),
        ("toy_task:missing", "^task 'toy_task:missing' cannot be loaded: .*has no attribute 'missing'$"),
        (":task", "^task ':task' cannot be loaded: Empty module name$"),
        ("test_task:not_a_task", r"leads to a str, not to a ddco_pyro\.task\.Task$"),
    ],
)
def test_a_task_that_cannot_be_found_says_why(name, message):
    with pytest.raises(UnknownTask, match=message):
        find_task(name)


def test_the_toy_task_depends_on_its_seed_alone():
    one, same, other = (run_episode(toy_task.task, "supervisor", seed).record for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.observations["offsets"], same.observations["offsets"])
    assert not np.array_equal(one.observations["offsets"][0], other.observations["offsets"][0])


def test_the_toy_tasks_supervisor_is_better_than_its_open_loop():
    rates = {
        name: np.mean([run_episode(toy_task.task, name, seed).outcome["success"] for seed in range(30)])
        for name in toy_task.task.policies
    }
    assert rates["supervisor"] > 0.9
    assert 0.2 < rates["open_loop"] < 0.8
