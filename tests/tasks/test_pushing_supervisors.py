"""The pushing task's supervisors: goals, intentions, and plans that are functions of the state."""

import json
import subprocess
import sys

import numpy as np
import pytest
from ddco_tasks.pushing import environment as pushing
from ddco_tasks.pushing.environment import single, task

from ddco_pyro.simulation.episodes import run_episode


@pytest.mark.parametrize(
    ("name", "least"),
    [("scripted", 25), pytest.param("supervisor", 25, marks=pytest.mark.slow), ("scripted_noisy", 15)],
)
def test_supervisors_reach_goals(name: str, least: int) -> None:
    measures = run_episode(task, name, 3).outcome
    assert measures["goals"] >= least
    assert measures["topples"] <= 3


def test_intentions_are_recorded_and_the_hand_is_inexact() -> None:
    environment = task.load(0)
    policy = task.policies["scripted_noisy"](environment)
    exact = task.policies["scripted"](environment)
    policy.reset(0)
    step = environment.reset()
    offsets = []
    for _ in range(300):
        executed = policy.act(step.observation)
        np.testing.assert_array_equal(policy.intended, exact.act(step.observation))
        offsets.append(executed - policy.intended)
        step = environment.step(executed)
    environment.close()
    assert np.std(offsets) == pytest.approx(pushing.supervisor.HAND, rel=0.3)


def test_the_scripted_supervisor_is_a_function_of_the_observation() -> None:
    record = run_episode(single, "scripted_noisy", 1).record
    environment = single.load(0)
    policy = single.policies["scripted"](environment)
    for row in np.random.default_rng(0).permutation(len(record)):
        observation = {key: value[row] for key, value in record.observations.items()}
        np.testing.assert_array_equal(policy.act(observation), record.actions[row])
    environment.close()


DIGESTS = """
import hashlib, json
from ddco_pyro.simulation.episodes import run_episode
from ddco_tasks.pushing.environment import single
names = ("supervisor", "supervisor_noisy", "scripted_noisy", "supervisor_every_step")
found = [hashlib.sha256(run_episode(single, name, 4).record.actions.tobytes()).hexdigest() for name in names]
"""


def test_demonstrations_are_the_same_in_another_process() -> None:
    here: dict[str, list[str]] = {}
    exec(DIGESTS, here)
    command = [sys.executable, "-c", f"{DIGESTS}\nprint(json.dumps(found))"]
    there = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert here["found"] == there
    assert len(set(there)) == 4
