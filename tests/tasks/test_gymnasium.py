"""The tasks as Gymnasium environments, by shimmy, as docs/tasks.md says."""

import numpy as np
import pytest

from ddco_pyro.simulation.episodes import run_episode
from ddco_pyro.simulation.task import find_task


@pytest.mark.filterwarnings("ignore:.*DISPLAY")
@pytest.mark.parametrize("name", ["needle", "pushing_goal"])
def test_an_episode_is_the_one_of_a_rollout(name: str) -> None:
    task = find_task(name)  # the tasks choose a renderer, before shimmy does
    shimmy = pytest.importorskip("shimmy.dm_control_compatibility")
    episode, loaded = run_episode(task, "supervisor", seed=2).record, task.load(2)
    environment, policy = shimmy.DmControlCompatibilityV0(loaded), task.policies["supervisor"](loaded)
    policy.reset(2)
    seen, _ = environment.reset()
    for step in range(len(episode)):
        for key, values in episode.observations.items():
            np.testing.assert_array_equal(seen[key], values[step])
        seen, _, terminated, truncated, _ = environment.step(np.asarray(policy.act(seen)))
        assert (terminated or truncated) == (step == len(episode) - 1)
    environment.close()
