"""Bin picking against independent truths: MuJoCo's cameras, a dead band in small steps, mishaps by hand."""

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from ddco_tasks import psm
from ddco_tasks.bin_picking import alone, candidates, geometry, objects, task
from ddco_tasks.bin_picking import environment as bin_picking
from ddco_tasks.bin_picking.environment import Environment
from ddco_tasks.bin_picking.instrument import BACKLASH, slack_after
from ddco_tasks.bin_picking.trials import Attempt, End, Trials
from ddco_tasks.rendering import mujoco

SEED = 2  # a bin of three objects


@pytest.fixture
def environment() -> Iterator[Environment]:
    """A bin of three objects after its reset."""
    environment = task.load(SEED)
    environment.reset()
    yield environment
    environment.close()


def go(environment: Environment, position: tuple[float, float, float], jaw: float, turn: float = 0.8) -> dict:
    """A control step that truly brings the gripper to ``position`` [3] (m), up to what is not repeatable."""
    joints = psm.inverse(geometry.upright(turn, np.array(position)))
    return environment.step(np.append(environment.physics.command(joints), jaw))


def lay(environment: Environment, number: int, position: tuple[float, float, float]) -> None:
    """Put an object somewhere, along x."""
    environment.physics.place_object(number, np.array(position), np.array([1.0, 0.0, 0.0, 0.0]))


# Geometry and cameras.


@pytest.mark.parametrize(("eye", "right"), [("left_eye", False), ("right_eye", True)])
def test_points_are_where_mujocos_camera_sees_them(environment: Environment, eye: str, right: bool) -> None:
    seen = mujoco.Camera(environment.physics, geometry.IMAGE_SIZE, geometry.IMAGE_SIZE, eye)
    points = np.random.default_rng(0).uniform([-0.025, -0.025, 0.0], [0.025, 0.025, 0.03], (20, 3))
    column, row, depth = seen.matrix @ np.column_stack([points, np.ones(20)]).T
    truth = np.column_stack([column / depth, row / depth])
    # from corners or from centres
    np.testing.assert_allclose(geometry.project(points, right), truth, atol=0.51)


def test_a_pixel_is_turned_back_into_its_point() -> None:
    points = np.random.default_rng(1).uniform(-0.025, 0.025, (20, 3)) * [1, 1, 0]
    points += [0, 0, geometry.OBJECT_HEIGHT]
    for point in points:
        np.testing.assert_allclose(geometry.lying_at(geometry.project(point)), point, atol=1e-12)


# The instrument.


def test_backlash_is_a_dead_band_moved_through_in_small_steps() -> None:
    generator = np.random.default_rng(3)
    motors = np.zeros(6)
    slack, joints = np.zeros(6), np.zeros(6)
    for _ in range(20):
        goal = motors + 3 * BACKLASH * generator.standard_normal(6)
        slack = slack_after(slack, goal - motors)
        # a joint is pushed by whichever side of the gap touches it
        for step in np.linspace(motors, goal, 200):
            joints = np.where(step - joints > BACKLASH, step - BACKLASH, joints)
            joints = np.where(joints - step > BACKLASH, step + BACKLASH, joints)
        motors = goal
        np.testing.assert_allclose(motors - slack, joints, atol=1e-12)


# Grasp candidates.


@pytest.mark.parametrize("angle", [0.1, 0.8, 1.7, 2.6])
def test_the_direction_of_a_candidate_is_across_the_wire(angle: float) -> None:
    mask = np.zeros((256, 256), np.uint8)
    along = 60 * np.array([np.cos(angle), -np.sin(angle)])
    ends = [tuple(np.round([128, 128] + sign * along).astype(int).tolist()) for sign in (-1, 1)]
    cv2.line(mask, *ends, 255, 4)
    for candidate in candidates.draw(mask, np.random.RandomState(0)):
        if np.linalg.norm(candidate.pixel - 128) < 45:  # not at its ends
            assert abs(np.cos(candidate.turn - angle)) < 0.06
            offset = candidate.pixel - 128
            assert abs(offset[0] * np.sin(angle) + offset[1] * np.cos(angle)) < 1.0  # on its axis


# Contact.


@pytest.mark.parametrize("number", range(3))
def test_friction_holds_what_the_jaws_close_on_until_they_open(environment: Environment, number: int) -> None:
    physics, turn = environment.physics, np.pi / 2  # the object lies along x
    lay(environment, number, (0.0, 0.012, 0.002))
    for height, jaw in ((0.020, 1), (0.003, 1), (0.003, 0), (0.030, 0)):
        go(environment, (0.0, 0.012, height), jaw, turn)
    assert physics.held() == {number}
    grip = physics.centres()[number] - physics.gripper().position
    for y in (0.0, 0.012):
        go(environment, (0.0, y, 0.030), 0, turn)
    np.testing.assert_allclose(physics.centres()[number] - physics.gripper().position, grip, atol=5e-4)
    go(environment, (0.0, 0.012, 0.030), 1, turn)
    assert physics.held() == frozenset()
    attempt = environment.task.trials.attempts[-1]
    assert (attempt.lifted, attempt.returned) == ({number}, True)


@pytest.mark.parametrize("kind", objects.UNSEEN)
def test_objects_that_no_demonstration_has_shown_are_held_and_only_the_thread_hangs_down(kind: str) -> None:
    environment = alone[kind].load(0)
    environment.reset()
    physics = environment.physics
    lay(environment, 0, (0.0, 0.012, 0.0035))
    for height, jaw in ((0.020, 1), (0.003, 1), (0.003, 0), (0.030, 0), (0.030, 0)):
        go(environment, (0.0, 0.012, height), jaw, np.pi / 2)
    assert physics.held() == {0}
    own = physics.model.geom_bodyid >= physics.model.name2id("object_0", "body")
    thickness = np.ptp(physics.data.geom_xpos[own, 2])  # m, between middles of its parts
    assert (thickness > 0.008) == (kind == "thread")
    go(environment, (0.0, 0.012, 0.030), 1, np.pi / 2)
    assert physics.held() == frozenset()
    environment.close()


# What can go wrong: the episode ends, with a name.


def test_an_object_outside_ends_the_bin(environment: Environment) -> None:
    lay(environment, 1, (0.0, 0.09, 0.002))
    assert go(environment, (0.0, 0.0, 0.03), 1).last()
    assert task.outcome(environment)["ended_lost"] == 1.0


def test_a_grasp_on_the_foam_ends_the_bin(environment: Environment) -> None:
    assert not go(environment, (0.02, 0.02, 0.0), 1).last()
    assert go(environment, (0.02, 0.02, -0.006), 1).last()
    assert task.outcome(environment)["ended_foam"] == 1.0


def test_a_simulation_that_breaks_down_ends_with_finite_observations(environment: Environment) -> None:
    environment.physics.named.data.qvel["object_0"] = np.nan
    step = go(environment, (0.0, 0.0, 0.03), 1)
    assert step.last()
    assert task.outcome(environment)["ended_unstable"] == 1.0
    assert all(np.isfinite(value).all() for value in step.observation.values())


def test_a_grasp_is_of_what_is_seen_in_the_bin(environment: Environment, monkeypatch) -> None:
    """Both eyes see the inner edge of the accept cup, too."""
    seen = np.zeros((geometry.IMAGE_SIZE, geometry.IMAGE_SIZE, 2), np.uint8)
    edge = np.array([[-0.04, y, 0.002] for y in np.linspace(-0.02, 0.02, 81)])
    pixels = geometry.project(edge).round().astype(int)
    seen[pixels[:, 1], pixels[:, 0]] = 255
    monkeypatch.setattr(bin_picking.camera, "masks", lambda _: seen)
    go(environment, (0.0, 0.02, 0.03), 0)
    assert go(environment, (0.0, 0.02, 0.03), 1).last()
    assert task.outcome(environment)["ended_unseen"] == 1.0


def test_four_misses_in_a_row_end_the_bin(environment: Environment) -> None:
    jaws = [step % 2 for step in range(8)]  # close and open over the bin
    ended = [go(environment, (0.0, 0.02, 0.03), jaw).last() for jaw in jaws]
    assert ended == [False] * 7 + [True]
    found = task.outcome(environment)
    counts = [found[name] for name in ("ended_missed", "attempts", "empty", "recovered")]
    assert counts == [1.0, 4.0, 4.0, 4.0]


# Bookkeeping, on attempts made up by hand.


def test_measures_of_attempts() -> None:
    none, first, both = frozenset[int](), frozenset({0}), frozenset({0, 1})
    attempts = [
        Attempt(3, none, none, ("bin",), 10),  # empty, recovered from
        Attempt(3, none, none, ("reject",), 10),  # empty, and carried to a cup
        Attempt(3, both, both, ("bin", "bin"), 10),  # several, recovered from
        Attempt(3, both, first, ("accept",), 10),  # one slipped, the other into its cup
        Attempt(2, frozenset({1}), frozenset({1}), ("bin",), 10),  # one, dropped for no reason
        Attempt(2, frozenset({1}), frozenset({1}), ("accept",), 10),  # into the wrong cup
        Attempt(1, frozenset({2}), frozenset({2}), (), 10),  # never let go
    ]
    trials = Trials(["pin", "wire", "needle"], attempts, end=End.MISSED)
    expected = {"success": 0, "cleared": 0, "ended_missed": 1, "objects": 3, "attempts": 7}
    expected |= {"single": 3, "empty": 2}
    expected |= {"several": 2, "slipped": 1, "due_cups": 3, "kept": 2, "delivered": 2, "sorted": 1}
    expected |= {"due_recoveries": 3, "recovered": 2, "nothing": 2, "nothing_recovered": 1}
    found = trials.measures()
    assert {name: found[name] for name in expected} == expected
    assert not trials.missed()


@pytest.mark.parametrize(("cups", "success"), [(("accept", "reject"), 1.0), (("accept", "accept"), 0.0)])
def test_success_is_every_object_in_its_own_cup(cups: tuple[str, str], success: float) -> None:
    attempts = [Attempt(2 - n, frozenset({n}), frozenset({n}), (cup,), 10) for n, cup in enumerate(cups)]
    found = Trials(["pin", "wire"], attempts, end=End.CLEARED).measures()
    assert (found["cleared"], found["success"]) == (1.0, success)
