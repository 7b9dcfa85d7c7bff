"""How a task is found, and the toy task itself."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest
import toy_task

from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import OutcomeError, UnknownTask, find_task
from ddco_pyro.spec.base import TASKS


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

    monkeypatch.setattr("ddco_pyro.simulation.task.entry_points", entry_points)
    assert find_task("toy") is toy_task.task
    with pytest.raises(
        UnknownTask, match=r"^no task is registered as 'toi' \(registered: toy\); module:name works too$"
    ):
        find_task("toi")


def test_a_registered_task_whose_packages_are_missing_is_one_line(monkeypatch):
    point = EntryPoint("needs", "no_such_package.of_mine:task", TASKS)
    monkeypatch.setattr("ddco_pyro.simulation.task.entry_points", lambda group: [point])
    with pytest.raises(UnknownTask, match=r"^task 'needs' needs the package 'no_such_package', which"):
        find_task("needs")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no_such_module:task", "^task 'no_such_module:task' cannot be loaded: No module named 'no_such_module'$"),
        ("toy_task:missing", "^task 'toy_task:missing' cannot be loaded: .*has no attribute 'missing'$"),
        (":task", "^task ':task' cannot be loaded: Empty module name$"),
        ("toy_task:SPEC", r"leads to a str, not to a ddco_pyro\.simulation\.task\.Task$"),
    ],
)
def test_a_task_that_cannot_be_found_says_why(name, message):
    with pytest.raises(UnknownTask, match=message):
        find_task(name)


def with_outcome(outcome, **measures):
    return replace(toy_task.task, outcome=lambda environment: outcome, measures=measures)


def test_what_a_task_does_not_declare_is_a_mean_but_success():
    task = with_outcome({}, topples="mean", inserted="rate")
    assert [task.kind(name) for name in ("success", "topples", "inserted")] == ["rate", "mean", "rate"]
    assert [with_outcome({}).kind(name) for name in ("success", "topples", "inserted")] == ["rate", "mean", "mean"]


def test_an_outcome_is_what_was_declared():
    outcome = {"success": np.float32(1), "inserted": np.nan, "topples": 3}
    task = with_outcome(outcome, success="rate", inserted="rate", topples="mean")
    assert task.measured(None) == pytest.approx({"success": 1.0, "inserted": np.nan, "topples": 3.0}, nan_ok=True)
    assert all(type(value) is float for value in task.measured(None).values())
    assert with_outcome(outcome).measured(None).keys() == outcome.keys()


@pytest.mark.parametrize(
    ("outcome", "measures", "message"),
    [
        (
            {"success": 0.5},
            {},
            r"^task 'toy': success is 0\.5, and a rate is 0 or 1 in every episode; make it a mean, ",
        ),
        ({"done": 2.0}, {"done": "rate"}, r"^task 'toy': done is 2, and a rate is 0 or 1 in every episode; make it a"),
        (
            {"success": 1.0, "topples": 2.0},
            {"success": "rate", "topple": "mean"},
            r"^task 'toy': its outcome has success, topples, and its measures are success, topple; declare all of them",
        ),
    ],
)
def test_an_outcome_that_is_not_what_was_declared_is_refused(outcome, measures, message):
    task = with_outcome(outcome, **measures)
    with pytest.raises(OutcomeError, match=message):
        task.measured(None)
    with pytest.raises(OutcomeError, match=message):
        run_episode(task, "supervisor", 0)


@pytest.mark.parametrize(
    ("measures", "message"),
    [
        ({"success": "mean"}, "task 'toy': success is a rate, by which methods are compared; call the mean otherwise"),
        ({"topples": "count"}, "task 'toy': topples is declared a 'count'; it has to be a 'rate' or a 'mean'"),
    ],
)
def test_a_wrong_declaration_is_refused(measures, message):
    with pytest.raises(OutcomeError) as caught:
        with_outcome({}, **measures)
    assert str(caught.value) == message
