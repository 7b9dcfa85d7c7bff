"""Every registered task as a Gymnasium environment: Gymnasium's own check, and the same episodes as in a rollout."""

from __future__ import annotations

from importlib.metadata import entry_points

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ddco_pyro.simulation import environments
from ddco_pyro.simulation.environments import TaskEnvironment
from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import find_task
from ddco_pyro.spec.base import TASKS

NAMES = sorted(point.name for point in entry_points(group=TASKS))
QUICK = ("needle", "pushing_goal")
"""The others differ from them in what is observed or in when they end; a bin takes long."""
each = pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES]
)


@pytest.mark.filterwarnings("ignore:.*:UserWarning:gymnasium.*")
@each
def test_gymnasiums_own_check(name: str) -> None:
    environment = gymnasium.make(f"ddco_pyro.simulation.environments:ddco/{name}-v0", render_mode="rgb_array")
    check_env(environment.unwrapped, skip_render_check=True)
    environment.reset(seed=1)
    frame = environment.render()
    assert (frame.dtype, frame.ndim) == (np.uint8, 3)
    environment.close()


@each
def test_an_episode_is_the_one_of_a_rollout(name: str) -> None:
    task = find_task(name)
    episode = run_episode(task, "supervisor", seed=2)
    environment = TaskEnvironment(name)
    seen, _ = environment.reset(seed=2)
    policy = task.policies["supervisor"](environment._environment)
    policy.reset(2)
    for step in range(len(episode.record)):
        for key, value in episode.record.observations.items():
            np.testing.assert_array_equal(seen[key], value[step])
        seen, _, terminated, truncated, info = environment.step(np.asarray(policy.act(seen)))
        assert (terminated or truncated) == (step == len(episode.record) - 1)
    assert {key: float(value) for key, value in info.items()} == pytest.approx(episode.outcome, nan_ok=True)
    environment.close()


def test_ends_are_told_apart() -> None:
    """The toy task ends by itself: at the goal, or after its last step; either way nothing follows."""
    environment = TaskEnvironment("toy_task:task")
    environment.reset(seed=0)
    ends = [environment.step(np.zeros(2))[2:4] for _ in range(12)]
    assert ends == [(False, False)] * 11 + [(True, False)]
    first, _ = environment.reset()
    second, _ = environment.reset()
    assert not np.array_equal(first["offsets"], second["offsets"])


def test_registering_again_changes_nothing() -> None:
    before = dict(gymnasium.registry)
    environments.register()
    assert gymnasium.registry == before
    assert {f"ddco/{name}-v0" for name in NAMES} <= set(before)
