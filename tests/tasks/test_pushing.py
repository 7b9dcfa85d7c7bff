"""The pushing task against independent truths: MuJoCo's poses, Coulomb friction, statics, collisions."""

from collections.abc import Iterator

import numpy as np
import pytest
from ddco_tasks.planning import points_along
from ddco_tasks.pushing import environment as pushing
from ddco_tasks.pushing import geometry as pushing_geometry
from ddco_tasks.pushing.environment import Environment, limited, single, task

from ddco_pyro.simulation.episodes import run_episode

GRAVITY, FRICTION = 9.81, 0.4


@pytest.fixture
def environment() -> Iterator[Environment]:
    """The environment of seed 0, after its reset."""
    environment = task.load(0)
    environment.reset()
    yield environment
    environment.close()


def arrange(environment: Environment, angles: np.ndarray, box: float, goal: float) -> None:
    """Put arm, box and goal somewhere."""
    with environment.physics.reset_context():
        environment.physics.place_arm(angles)
        environment.physics.place_box(box)
        environment.physics.place_goal(goal)


def push(environment: Environment, height: float, distance: float = 0.3) -> float:
    """Push the box from the left at a height, 5 mm a step; the largest tilt (rad) on the way."""
    start = np.array([-0.2, height])
    arrange(environment, pushing_geometry.inverse(start, 0.3), 0.0, 0.45)
    tilts = []
    for step in range(round(distance / 0.005)):
        goal = pushing_geometry.inverse(start + np.array([0.005 * (step + 1), 0.0]), 0.3)
        environment.step((goal - environment.physics.joint_angles()) / 0.05)
        tilts.append(abs(environment.physics.box()[2]))
    return max(tilts)


# Kinematics.


def test_forward_kinematics_is_mujocos(environment: Environment) -> None:
    low, high = pushing_geometry.JOINT_RANGES.T
    for angles in np.random.default_rng(0).uniform(low, high, (20, 3)):
        arrange(environment, angles, 0.0, 0.3)
        tip = pushing_geometry.tip_position(angles)
        np.testing.assert_allclose(tip, environment.physics.tip(), atol=1e-9)


def test_inverse_kinematics_is_the_inverse() -> None:
    for x in np.linspace(-0.65, 0.65, 9):
        for z in (0.1, 0.25, 0.45):
            for pitch in (-0.3, 0.0, 0.3):
                if np.hypot(x - 0.3 * np.sin(pitch), 0.95 - z - 0.3 * np.cos(pitch)) > 0.99:
                    continue
                angles = pushing_geometry.inverse(np.array([x, z]), pitch)
                np.testing.assert_allclose(pushing_geometry.tip_position(angles), [x, z], atol=1e-9)
                assert np.sum(angles) == pytest.approx(pitch)


def test_clear_is_what_points_along_the_links_say() -> None:
    generator = np.random.default_rng(1)
    low, high = pushing_geometry.JOINT_RANGES.T
    verdicts = []
    for angles in generator.uniform(low, high, (400, 3)):
        corners = np.array(pushing_geometry.joints_positions(angles))
        points = points_along(corners, np.linspace(0.0, 1.0, 2000))
        inside = (np.abs(points[:, 0] - 0.1) < 0.11 + 0.02) & (points[:, 1] < 0.28 + 0.02)
        clear = not inside.any() and corners[1:, 1].min() >= 0.03
        verdicts.append(clear)
        assert pushing_geometry.is_clear(angles, 0.1, 0.02) == clear
    assert 0.05 < np.mean(verdicts) < 0.95


# The box.


@pytest.mark.parametrize("speed", [0.4, 0.8])
def test_a_sliding_box_stops_by_coulomb_friction(environment: Environment, speed: float) -> None:
    arrange(environment, pushing.RAISED, 0.0, 0.45)
    environment.physics.named.data.qvel["box_x"] = speed
    for _ in range(10):
        environment.step(np.zeros(3))
    assert environment.physics.box()[0] == pytest.approx(speed**2 / (2 * FRICTION * GRAVITY), rel=0.05)


def test_a_low_push_slides_the_box_and_a_high_one_topples_it(environment: Environment) -> None:
    """Statics: it tips over its edge where the push is above half its width over the friction, 0.2 m."""
    assert push(environment, 0.10) < 0.05
    assert environment.physics.box()[0] > 0.2
    assert environment.task.counts.topples == 0
    push(environment, 0.23)
    assert environment.task.counts.topples == 1


def test_a_toppled_box_is_put_back_upright_somewhere_else(environment: Environment) -> None:
    for angle in (1.0, -1.0):
        arrange(environment, pushing.RAISED, 0.1, 0.3)
        environment.physics.named.data.qpos["box_tilt"] = angle
        before = environment.task.counts.topples
        step = environment.step(np.zeros(3))
        assert environment.task.counts.topples == before + 1
        assert step.reward == 0.0
        x, z, tilt = step.observation["box_pose"]
        assert (z, tilt) == (pytest.approx(0.125), 0.0)
        assert x != pytest.approx(0.1, abs=1e-3)
        assert abs(x - 0.3) >= pushing.MIN_DISTANCE
        assert step.observation["goal"] == 0.3


# Goals.


def test_a_goal_is_reached_by_a_box_at_rest_within_its_tolerance(environment: Environment) -> None:
    for offset, tilt, speed, reached in (
        (0.029, 0.0, 0.0, True),
        (0.031, 0.0, 0.0, False),
        (0.0, 0.11, 0.0, False),
        (0.0, 0.0, 0.021, False),
    ):
        arrange(environment, pushing.RAISED, 0.1 + offset, 0.1)
        environment.physics.named.data.qpos["box_tilt"] = tilt
        environment.physics.named.data.qvel["box_x"] = speed
        assert pushing.is_reached(environment.physics) == reached


def test_a_reached_goal_is_drawn_anew_on_the_other_side(environment: Environment) -> None:
    goals = []
    for number in range(12):
        arrange(environment, pushing.RAISED, environment.physics.goal(), environment.physics.goal())
        box = environment.physics.box()[0]
        step = environment.step(np.zeros(3))
        assert step.reward == 1.0
        assert environment.task.counts.goals == number + 1
        goals.append(step.observation["goal"][0] - box)
        assert environment.step(np.zeros(3)).reward == 0.0
    assert (np.sign(goals[1:]) == -np.sign(goals[:-1])).all()
    assert np.min(np.abs(goals)) >= pushing.MIN_DISTANCE - 1e-3


# Variants.


@pytest.mark.parametrize(
    ("variant", "steps", "missed"),
    [(task, 2000, np.nan), (limited, 2000, 2000 // 250), (single, 250, 1.0)],
    ids=["task", "limited", "single"],
)
def test_an_arm_that_does_nothing_misses_its_goals(variant: pushing.Task, steps: int, missed: float) -> None:
    environment = variant.load(2)
    environment.reset()
    taken = 1
    while not environment.step(np.zeros(3)).last() and taken < 3000:
        taken += 1
    measures = variant.outcome(environment)
    environment.close()
    assert taken == variant.steps == steps
    assert (measures["success"], measures["goals"]) == (0.0, 0.0)
    assert measures["missed"] == pytest.approx(missed, nan_ok=True)


def test_an_episode_about_one_goal_ends_where_it_is_reached() -> None:
    for seed in range(4):
        episode = run_episode(single, "scripted", seed)
        assert episode.outcome["goals"] == episode.outcome["success"] == 1.0
        assert len(episode.record) < single.steps


# Pictures.


def test_a_picture_shows_where_things_are_and_nothing_else(environment: Environment) -> None:
    """Neither how fast they move nor what has happened in the episode."""
    angles = pushing_geometry.inverse(np.array([0.0, 0.5]), 0.0)
    draw = task.cameras["camera"].draw
    arrange(environment, angles, -0.3, 0.3)
    before = draw(environment)
    assert before.shape == (480, 640, 3)
    for _ in range(5):
        environment.step(np.array([0.5, -0.5, 0.5]))
    environment.task.counts.goals += 3
    assert (draw(environment) != before).any()
    arrange(environment, angles, -0.3, 0.3)
    environment.physics.data.qvel[:] = 1.0
    np.testing.assert_array_equal(draw(environment), before)
