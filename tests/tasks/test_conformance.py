"""What the library relies on, checked over every registered task."""

import math
from collections.abc import Iterator
from importlib.metadata import entry_points

import dm_env
import numpy as np
import pytest

from ddco_pyro.simulation.task import Policy, Task, find_task
from ddco_pyro.spec.base import TASKS

NAMES = sorted(point.name for point in entry_points(group=TASKS))
QUICK = ("needle", "pushing_goal", "bin_picking")
"""The others differ from them in what is observed or in when they end."""


EACH = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES]


@pytest.fixture(scope="module", params=EACH)
def task(request: pytest.FixtureRequest) -> Task:
    """Each registered task in turn."""
    return find_task(request.param)


def make(task: Task, name: str, seed: int) -> tuple[dm_env.Environment, Policy]:
    """An environment and the named policy in it, both ready to start."""
    environment = task.load(seed)
    policy = task.policies[name](environment)
    policy.reset(seed)
    return environment, policy


def episode(environment: dm_env.Environment, policy: Policy) -> Iterator[tuple[dm_env.TimeStep, np.ndarray]]:
    """Time steps to the episode's end, each with the action that led to it."""
    time_step = environment.reset()
    while not time_step.last():
        action = policy.act(time_step.observation)
        time_step = environment.step(action)
        yield time_step, action


@pytest.fixture(scope="module")
def supervised(task: Task) -> Iterator[tuple[dm_env.Environment, list[dm_env.TimeStep], np.ndarray]]:
    """An environment after a whole episode of the supervisor, the time steps, and the actions [T, A]."""
    environment, policy = make(task, "supervisor", seed=2)
    steps, actions = zip(*episode(environment, policy), strict=True)
    yield environment, list(steps), np.array(actions)
    environment.close()


def test_observations_and_actions_follow_their_spec(supervised) -> None:
    environment, steps, actions = supervised
    spec = environment.observation_spec()
    for step in steps:
        assert set(step.observation) == set(spec)
        for key, value in step.observation.items():
            spec[key].validate(value)
    spec = environment.action_spec()
    for action in actions:
        spec.validate(action.astype(spec.dtype))


def test_observations_are_finite_and_change(task: Task, supervised) -> None:
    """Within an episode, or from the start of one to that of another: such as a goal that stays."""
    _, steps, _ = supervised
    for key in steps[0].observation:
        values = np.array([step.observation[key] for step in steps], float)
        assert np.isfinite(values).all(), key
        assert np.ptp(values, axis=0).max() > 0 or np.ptp(at_starts(task, key), axis=0).max() > 0, key


def at_starts(task: Task, key: str) -> list[np.ndarray]:
    """An observation at the start of some episodes."""
    seen = []
    for seed in range(6):
        environment = task.load(seed)
        seen.append(environment.reset().observation[key])
        environment.close()
    return seen


def test_the_outcome_is_what_was_declared_with_success_among_it(task: Task, supervised) -> None:
    outcome = task.outcome(supervised[0])
    assert outcome.keys() == task.measures.keys()
    assert {type(value) for value in outcome.values()} == {float}
    rates = {name: outcome[name] for name, kind in task.measures.items() if kind == "rate"}
    assert rates.pop("success") in (0.0, 1.0)
    assert all(value in (0.0, 1.0) or math.isnan(value) for value in rates.values())


def test_frame_is_a_picture_of_something(task: Task, supervised) -> None:
    picture = task.frame(supervised[0])
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    assert picture.std() > 10


def test_cameras_follow_their_spec(task: Task) -> None:
    environment = task.watched(3, task.cameras)
    seen, spec = environment.reset().observation, environment.observation_spec()
    for name, camera in task.cameras.items():
        spec[name].validate(seen[name])
        assert seen[name].shape == (*camera.size, 3)
        assert seen[name].std() > 10
    environment.close()


def test_equal_seeds_give_equal_episodes_to_their_ends(task: Task, supervised) -> None:
    environment, policy = make(task, "supervisor", seed=2)
    before, steps, actions = supervised
    again = episode(environment, policy)
    pairs = enumerate(zip(again, steps, actions, strict=True))
    for number, ((step, action), first_step, first_action) in pairs:
        np.testing.assert_array_equal(action, first_action, err_msg=f"step {number}")
        np.testing.assert_equal(step._asdict(), first_step._asdict(), err_msg=f"step {number}")
    np.testing.assert_equal(task.outcome(environment), task.outcome(before))
    environment.close()


def test_other_seeds_start_elsewhere(task: Task) -> None:
    starts = []
    for seed in (0, 1):
        environment = task.load(seed)
        starts.append(environment.reset().observation)
        environment.close()
    assert any(not np.array_equal(starts[0][key], starts[1][key]) for key in starts[0])
