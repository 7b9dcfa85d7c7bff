"""Pushing whose goal is shown once: nothing after the cue tells the goal, and outcomes are the box's."""

import numpy as np
import pytest
from ddco_tasks.pushing import cue, environment
from ddco_tasks.pushing.physics import Physics

from ddco_pyro.simulation.episodes import run_episode


class Sided(np.random.RandomState):
    """Random numbers of a seed whose choice of a side is given."""

    side = 1

    def choice(self, sides: list[int]) -> int:  # type: ignore[override]
        """The side; as many numbers are drawn as without."""
        super().choice(sides)
        return self.side


def twin(seed: int, side: int) -> environment.Environment:
    """The episode of a seed with the goal on a side."""
    random = Sided(seed)
    random.side = side
    physics = Physics.from_xml_path(str(environment.HERE / "pushing.xml"))
    return environment.Environment(physics, cue.Cued(random=random), n_sub_steps=environment.SUB_STEPS)


def test_until_the_box_has_come_the_goal_is_told_by_the_cue_alone() -> None:
    """The supervisor, who knows the goal, acts in twins of an episode: its controls do not tell it either."""
    left, right = twins = [twin(3, side) for side in (-1, 1)]
    policies = [cue.task.policies["scripted_noisy_0.3"](one) for one in twins]
    for policy in policies:
        policy.reset(3)
    seen = [one.reset().observation for one in twins]
    steps = 0
    while seen[0]["box_pose"][0] > 0.5:
        assert (seen[0]["cue"], seen[1]["cue"]) == ((-0.35, 0.35) if steps < cue.CUE else (0.0, 0.0))
        assert (seen[0]["goal"], seen[1]["goal"]) == (-0.35, 0.35)
        for key in seen[0].keys() - {"goal", "goal_from_box", "goal_from_tip", "cue"}:  # which tell the goal
            np.testing.assert_array_equal(seen[0][key], seen[1][key], err_msg=f"{key}, step {steps}")
        if steps % 10 == 0:
            pictures = [cue.task.frame(one) for one in twins]
            assert np.array_equal(*pictures) == (steps >= cue.CUE)
        controls = [policy.act(one) for policy, one in zip(policies, seen, strict=True)]
        np.testing.assert_array_equal(*controls)
        seen = [one.step(control).observation for one, control in zip(twins, controls, strict=True)]
        steps += 1
    assert cue.ARRIVAL[0] <= steps <= cue.ARRIVAL[1]
    np.testing.assert_allclose(seen[0]["tip"], [0.0, 0.5], atol=0.05)
    controls = [policy.act(one) for policy, one in zip(policies, seen, strict=True)]
    assert np.abs(controls[0] - controls[1]).max() > 0.5
    assert left.physics.box()[0] == right.physics.box()[0]
    for one in twins:
        one.close()


@pytest.mark.parametrize("name", ["supervisor", "scripted", "scripted_noisy_0.3"])
def test_supervisors_succeed_on_both_sides(name: str) -> None:
    episodes = [run_episode(cue.task, name, seed) for seed in range(6)]
    assert all(episode.outcome["success"] for episode in episodes)
    sides = [set(episode.record.labels["side"]) for episode in episodes]
    assert {0} in sides
    assert {1} in sides
    for episode, (side,) in zip(episodes, sides, strict=True):
        assert np.sign(episode.record.observations["goal"][0]) == 2 * side - 1
        assert episode.record.observations["box_pose"][-1, 0] * (2 * side - 1) > 0.25


class Misinformed:
    """The supervisor, told that the goal is on the other side."""

    def __init__(self) -> None:
        self.policy = cue.Patient(cue.WayPoints())

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self.policy.reset(seed)

    def act(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """As the supervisor."""
        return self.policy.act({**observation, "goal": -observation["goal"]})


def test_a_box_on_the_other_side_is_no_success() -> None:
    outcomes = [run_episode(cue.task, Misinformed(), seed).outcome for seed in range(4)]
    assert outcomes == [{"success": 0.0, "wrong_side": 1.0, "toppled": 0.0, "missed": 0.0}] * 4
